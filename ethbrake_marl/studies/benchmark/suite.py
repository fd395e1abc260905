"""Frozen suites: lists of worlds that never change, each with the least harm known in it.

A suite is a folder of the package: ``suite.json``, and beside it one table of the best known for each list. A list is
its scenario's whole content, a seed, and the hash of its worlds' bytes. What differs in any of them is another suite.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from ethbrake_marl.errors import EthBrakeError, InvalidInput, unknown_name
from ethbrake_marl.evaluation.identity import worlds_sha256
from ethbrake_marl.files.messages import first_mistake
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.best_harm import world_identity
from ethbrake_marl.limits.best_harm_table import load_table
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample, Scenario, Task

SUITES = Path(__file__).resolve().parents[2] / "_suites"
CONTENT = "suite.json"
_LIMIT_BYTES, _TABLE_BYTES = 4 << 20, 16 << 20

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
Mean = Annotated[float, Field(ge=0.0)]


class Strict(BaseModel):
    """What is read from a file: nothing is unknown, converted or infinite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Content = TypeVar("Content", bound=Strict)


class ListContent(Strict):
    """One list, as the suite's file says it; harms are means over its worlds under ``harm_count`` (m2/s2)."""

    name: Name
    about: str
    scenario: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0)]
    worlds: Annotated[int, Field(ge=2, le=100_000)]
    harm_count: HarmCount
    worlds_sha256: Sha256
    table_sha256: Sha256
    full_brake_harm: Mean  # when every learner brakes fully: the score 0
    best_known_harm: Mean  # of the table: the score 1


class SuiteContent(Strict):
    """The whole of a suite's file."""

    format: Literal["ethbrake-suite"]
    format_version: Annotated[int, Field(ge=1, le=1)]
    name: Name
    lists: Annotated[tuple[ListContent, ...], Field(min_length=1, max_length=100)]


@dataclass(frozen=True, slots=True)
class SuiteList:
    """One list of a suite: what its file says, and its scenario."""

    content: ListContent
    scenario: Scenario
    folder: Path

    @property
    def name(self) -> str:
        """Of the list, in the suite."""
        return self.content.name

    @property
    def task(self) -> Task:
        """What is asked: the scenario's learners drive, and the list's harm counts."""
        return Task(self.scenario, self.scenario.learners, self.content.harm_count)

    def sample(self) -> Sample:
        """Its worlds; raises ``InvalidInput`` if this version draws others than the suite was frozen with."""
        sample = self.scenario.sample(self.content.worlds, self.content.seed)
        found = worlds_sha256(sample.worlds, sample.index)
        if found != self.content.worlds_sha256:
            raise InvalidInput(
                f"list {self.name}: the worlds drawn here have SHA-256 {found:.12}, the suite's have"
                f" {self.content.worlds_sha256:.12}; at least one world is another one"
            )
        return sample

    def best_known(self, sample: Sample) -> Floats:
        """The least harm known in each of its worlds, [n] m2/s2, from the table that belongs to the suite.

        Raises ``InvalidInput`` for another table, or one without some of the worlds; ``CorruptBundle`` for none.
        """
        file = self.folder / f"{self.name}.npz"
        if hashlib.sha256(read_plain(file, _TABLE_BYTES)).hexdigest() != self.content.table_sha256:
            raise InvalidInput(f"{file}: is not the table that belongs to the suite")
        harm = load_table(file).harm(world_identity(sample.worlds, self.task), self.content.harm_count)
        if not np.isfinite(harm).all():
            raise InvalidInput(f"{file}: holds {int(np.isfinite(harm).sum())} of the {len(harm)} worlds of its list")
        return harm


@dataclass(frozen=True, slots=True)
class Suite:
    """A frozen suite; ``sha256`` binds its lists and their tables."""

    name: str
    sha256: str
    lists: tuple[SuiteList, ...]

    @property
    def seeds(self) -> frozenset[int]:
        """The seeds of its lists, which no training and no choice of a policy may use."""
        return frozenset(each.content.seed for each in self.lists)


def suite_names(folder: Path | None = None) -> list[str]:
    """The suites of a folder; of the package, if none is given."""
    return sorted(path.parent.name for path in (folder or SUITES).glob(f"*/{CONTENT}"))


def load_suite(name: str, folder: Path | None = None) -> Suite:
    """The suite called ``name``, of those that ship or of another folder.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for a damaged one.
    """
    folder = folder or SUITES
    if name not in suite_names(folder):
        raise unknown_name("suite", name, suite_names(folder))
    file = folder / name / CONTENT
    content = read_content(file, SuiteContent)
    if content.name != name:
        raise InvalidInput(f"{file}: is suite {content.name}")
    lists = tuple(SuiteList(each, _scenario_of(file, each), file.parent) for each in content.lists)
    named = [each.name for each in lists]
    if twice := {name for name in named if named.count(name) > 1}:
        raise InvalidInput(f"{file}: list {min(twice)} stands in it twice")
    return Suite(name, plain_sha256(content.model_dump(mode="json")), lists)


def _scenario_of(file: Path, content: ListContent) -> Scenario:
    try:
        scenario = Scenario(**content.scenario)
    except InvalidInput as error:
        raise InvalidInput(f"{file}, list {content.name}: {error}") from None
    if not scenario.learners:
        raise InvalidInput(f"{file}, list {content.name}: nobody learns, so nobody can be scored")
    return scenario


def read_content(file: Path, kind: type[Content]) -> Content:
    """A JSON file as ``kind``; raises ``InvalidInput`` naming the file and the first mistake."""
    try:
        data = read_plain(file, _LIMIT_BYTES)
        parse_strict_json(data)  # no key twice, no NaN
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise InvalidInput(f"{file}: {first_mistake(error)}") from None
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"{file}: is no JSON, or was not written to its end: {error}") from None


def plain_sha256(content: Any) -> str:
    """SHA-256 of plain data: its JSON with sorted keys and no blanks."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
