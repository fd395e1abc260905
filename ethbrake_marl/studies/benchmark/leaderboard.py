"""The leaderboard: entries of one suite, sorted by their score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.studies.benchmark.entry import (
    Entry,
    read_entry,
)
from ethbrake_marl.studies.benchmark.suite import Suite, load_suite


@dataclass(frozen=True, slots=True)
class Row:
    """One entry of the table."""

    path: Path
    entry: Entry

    @property
    def ranked(self) -> bool:
        """Whether it drove every list; only then its mean is a score that can be compared."""
        return self.entry.overall is not None

    @property
    def score(self) -> Estimate:
        """Mean realised share over the lists that it drove."""
        return self.entry.mean_of_driven

    @property
    def policies(self) -> frozenset[str]:
        """Every policy that drove for it."""
        return frozenset(sha256 for each in self.entry.driven.values() for sha256 in each.policies.values())

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        entry = self.entry
        return {
            "file": self.path.name,
            "agent": entry.agent,
            "overall": None if entry.overall is None else entry.overall.to_json(),
            "mean_of_driven": entry.mean_of_driven.to_json(),
            "lists_driven": entry.lists_driven,
            "policies": sorted(self.policies),
            "lists": {name: each.model_dump(mode="json") for name, each in entry.lists.items()},
        }


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """Entries of one suite: those of all lists by their score, then the others by how many lists they drove."""

    suite: Suite
    rows: tuple[Row, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        told = {"suite": self.suite.name, "suite_sha256": self.suite.sha256}
        return {**told, "entries": [row.to_json() for row in self.rows]}


def read_leaderboard(paths: Sequence[Path], suite: Suite | None = None) -> Leaderboard:
    """Read and sort entries of one suite (default: the one that the first entry names).

    Raises ``InvalidInput`` naming the first file that is refused: no entry, changed since it was made, or of another
    suite.
    """
    if not paths:
        raise InvalidInput("leaderboard: no entries given; ethbrake benchmark writes them")
    rows = [Row(path, read_entry(path)) for path in paths]
    suite = load_suite(rows[0].entry.suite) if suite is None else suite
    names = {each.name for each in suite.lists}
    for row in rows:
        if row.entry.suite_sha256 != suite.sha256 or row.entry.lists.keys() != names:
            raise InvalidInput(
                f"{row.path}: is about another suite: {row.entry.suite} with SHA-256 {row.entry.suite_sha256:.12}, and"
                f" this is {suite.name} with {suite.sha256:.12}"
            )
    rows.sort(key=lambda row: (-row.entry.lists_driven, -row.score.value, row.entry.agent))
    return Leaderboard(suite, tuple(rows))
