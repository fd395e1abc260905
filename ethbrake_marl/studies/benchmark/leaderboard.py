"""The leaderboard: entries of one suite, checked against it and against each other, as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.progress import OnProgress
from ethbrake_marl.studies.benchmark.entry import (
    Entry,
    ListResult,
    bind_entry,
    make_entry,
    read_entry,
    suite_seed_used,
)
from ethbrake_marl.studies.benchmark.suite import Suite, SuiteList, load_suite

_SAME_HARM = 1e-6  # m2/s2, relative or absolute; of the same episodes computed by other versions


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
        return self.entry.mean_of_driven.estimate

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
            "overall": None if entry.overall is None else entry.overall.model_dump(mode="json"),
            "mean_of_driven": entry.mean_of_driven.model_dump(mode="json"),
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
    """Read entries of one suite (default: the one that the first entry names), and check them.

    Raises ``InvalidInput`` naming the first file that is refused: no entry, changed since it was made, of another
    suite, with a list or a world left out or other worlds, with figures that do not fit each other or the suite, of a
    policy made with a seed of the suite, or one that stands among the others twice.
    """
    if not paths:
        raise InvalidInput("leaderboard: no entries given; ethbrake benchmark writes them")
    rows = [Row(path, read_entry(path)) for path in paths]
    suite = load_suite(rows[0].entry.suite) if suite is None else suite
    for row in rows:
        check_entry(row.path, row.entry, suite)
    _check_twice(rows)
    rows.sort(key=lambda row: (-row.entry.lists_driven, -row.score.value, row.entry.agent))
    return Leaderboard(suite, tuple(rows))


def check_entry(path: Path, entry: Entry, suite: Suite) -> None:
    """Refuse an entry that is not of this suite, whole, and consistent; raises ``InvalidInput``."""
    if (entry.suite, entry.suite_sha256) != (suite.name, suite.sha256):
        raise InvalidInput(
            f"{path}: is about another suite: {entry.suite} with SHA-256 {entry.suite_sha256:.12}, and this is"
            f" {suite.name} with {suite.sha256:.12}"
        )
    names = [each.name for each in suite.lists]
    if missing := [name for name in names if name not in entry.lists]:
        raise InvalidInput(f"{path}: leaves out {count_of(len(missing), 'list')}: {', '.join(missing)}")
    if unknown := [name for name in entry.lists if name not in names]:
        raise InvalidInput(f"{path}: has a list that suite {suite.name} has not: {unknown[0]}")
    for each in suite.lists:
        result = entry.lists[each.name]
        if isinstance(result, ListResult):
            _check_list(f"{path}, list {each.name}", result, each)
            if used := suite_seed_used(result.policy_seeds, suite):
                raise InvalidInput(f"{path}, list {each.name}: {used}")
    _check_overall(path, entry, suite)


def _check_list(where: str, result: ListResult, each: SuiteList) -> None:
    """Refuse other worlds, and a share that does not follow from harm and suite."""
    content = each.content
    if result.worlds != content.worlds:
        raise InvalidInput(f"{where}: {count_of(result.worlds, 'world')}; the list has {content.worlds}")
    if result.worlds_sha256 != content.worlds_sha256:
        raise InvalidInput(
            f"{where}: other worlds: SHA-256 {result.worlds_sha256:.12}, those of the list have"
            f" {content.worlds_sha256:.12}"
        )
    possible = content.full_brake_harm - content.best_known_harm
    share = (content.full_brake_harm - result.harm(content.harm_count)) / possible
    if not _close(result.realised_share.value, share, _SAME_HARM / min(possible, 1.0)):
        raise InvalidInput(
            f"{where}: realised_share is {result.realised_share.value:g}, but the harm that it tells gives {share:g}"
        )
    for told in (result.realised_share, result.first_impact_harm, result.total_harm, result.collision_rate):
        if told.interval is None or not told.interval[0] <= told.value <= told.interval[1]:
            raise InvalidInput(f"{where}: {told.value:g} has no interval around it")


def _check_overall(path: Path, entry: Entry, suite: Suite) -> None:
    """Refuse a mean that is not that of the lists."""
    again = bind_entry(suite, entry.agent, entry.lists)
    same = entry.lists_driven == again.lists_driven and (entry.overall is None) == (again.overall is None)
    means = [told for told in (entry.mean_of_driven, entry.overall) if told is not None]
    mean = again.mean_of_driven.model_dump(mode="json")
    if not same or not all(_same_values(told.model_dump(mode="json"), mean) for told in means):
        raise InvalidInput(
            f"{path}: its mean share is not that of its {count_of(again.lists_driven, 'driven list')},"
            f" {again.mean_of_driven.value:g}"
        )


def _check_twice(rows: Sequence[Row]) -> None:
    """Refuse an agent that stands among the entries twice, and one that does in every world what another does."""
    by_agent: dict[object, Row] = {}
    by_outcomes: dict[object, Row] = {}
    for row in rows:
        outcomes = tuple(sorted((name, each.outcome_sha256) for name, each in row.entry.driven.items()))
        for found, key, what in (
            (by_agent, (row.entry.agent, row.policies), "is the same agent with the same policies"),
            (by_outcomes, outcomes, "does the same in every world"),
        ):
            other = found.setdefault(key, row)
            if other is not row:
                raise InvalidInput(f"{row.path}: {what} as {other.path}; give one of the two")


def verify(row: Row, suite: Suite, *, on_progress: OnProgress | None = None) -> str:
    """Let the agent of an entry drive again, and say in words what was found the same.

    Raises ``InvalidInput`` where something differs, and for an agent that is code: an entry alone runs nobody's code.
    """
    entry = row.entry
    if (file := parse_spec(entry.agent).file) is not None:
        raise InvalidInput(
            f"{row.path}: its agent is code ({file}), which is not run because an entry names it; read the code, and"
            f" make the entry yourself: {entry.command}"
        )
    again = make_entry(suite, entry.agent, on_progress=on_progress)
    bits = True
    for name, told in entry.lists.items():
        found = again.lists[name]
        where = f"{row.path}, list {name}"
        if isinstance(told, ListResult) != isinstance(found, ListResult):
            raise InvalidInput(f"{where}: {'was' if isinstance(told, ListResult) else 'was not'} driven, unlike here")
        if isinstance(told, ListResult) and isinstance(found, ListResult):
            _check_same(where, told, found)
            if told.outcome_sha256 != found.outcome_sha256 and entry.versions == again.versions:
                raise InvalidInput(f"{where}: outcome_sha256 is not that of driving again, with the same versions")
            bits = bits and told.outcome_sha256 == found.outcome_sha256
    return "the same, bit for bit" if bits else "the same figures, by other versions to other last digits"


def _check_same(where: str, told: ListResult, found: ListResult) -> None:
    """Refuse a result that driving again does not give."""
    if told.policies != found.policies:
        raise InvalidInput(f"{where}: was driven by another policy than the one that is here")
    one, other = (each.model_dump(mode="json", exclude={"outcome_sha256"}) for each in (told, found))
    for key, value in one.items():
        if not _same_values(value, other[key]):
            raise InvalidInput(f"{where}: {key} is {_shown(value)}, and driving again gives {_shown(other[key])}")


def _same_values(one: Any, other: Any) -> bool:
    """Whether plain data are the same, numbers up to what other versions may round otherwise."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same_values(value, other[key]) for key, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same_values, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return _close(one, other, _SAME_HARM)
    return bool(one == other)


def _shown(value: Any) -> str:
    return f"{value['value']:.9g}" if isinstance(value, Mapping) and "value" in value else str(value)


def _close(one: float, other: float, tolerance: float) -> bool:
    return abs(one - other) <= tolerance * max(1.0, abs(one), abs(other))
