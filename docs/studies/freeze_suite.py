"""Freezing a suite: once, from scenarios, seeds and tables of the best known; a change is another suite.

docs/benchmark.md, "How v2 was made". Import it to freeze another: ``freeze_suite(NAME, [NewList(...), ...], FOLDER)``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.inputs import make_lineup, worlds_sha256
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.files.store import write_file
from ethbrake_marl.limits.limits import BestHarmTable, table_bytes, task_problem
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.studies.benchmark import CONTENT, REFERENCE, ListContent, Suite, SuiteContent, load_suite


@dataclass(frozen=True, slots=True)
class NewList:
    """A list to be frozen."""

    name: str
    about: str  # one line
    scenario: Scenario
    seed: int
    worlds: int
    harm_count: HarmCount
    table: BestHarmTable  # the best known in all of its worlds


def freeze_suite(name: str, lists: Sequence[NewList], folder: Path) -> Suite:
    """Write the suite ``folder/name`` and read it again.

    Raises ``AlreadyExists`` for one that is there, ``InvalidInput`` for two lists with one seed (their worlds would not
    be independent), a table without some of the worlds, or a list where nothing is possible.
    """
    place = folder / name
    if place.exists():
        raise AlreadyExists(f"{place}: is frozen; give a changed suite another name")
    seeds = [each.seed for each in lists]
    if twice := {seed for seed in seeds if seeds.count(seed) > 1}:
        raise InvalidInput(f"suite {name}: two lists with seed {min(twice)}; each needs its own")
    frozen = [_freeze(each) for each in lists]
    content = SuiteContent(
        format="ethbrake-suite", format_version=1, name=name, lists=tuple(listed for listed, _ in frozen)
    )
    place.mkdir(parents=True)
    for listed, table in frozen:
        write_file(place / f"{listed.name}.npz", table)
    text = json.dumps(content.model_dump(mode="json"), indent=1, allow_nan=False)
    write_file(place / CONTENT, text.encode() + b"\n")
    return load_suite(name, folder)


def _freeze(new: NewList) -> tuple[ListContent, bytes]:
    """What the suite's file says of a list, and its table as bytes."""
    scenario, sample = new.scenario, new.scenario.sample(new.worlds, new.seed)
    task = Task(scenario, scenario.learners, new.harm_count)
    best = new.table.harm(task_problem(sample.worlds, task).identity, new.harm_count)
    full = evaluate(sample, make_lineup([REFERENCE], scenario), scenario=scenario, aftermath=False).complete()
    full_harm = float(full.outcome(REFERENCE).world_harm(new.harm_count).mean())
    if not best.mean() < full_harm:
        raise InvalidInput(f"list {new.name}: best known {best.mean():g}, full braking {full_harm:g}: nothing to gain")
    table = table_bytes(new.table)
    listed = ListContent(
        name=new.name,
        about=new.about,
        scenario=scenario.declared(),
        seed=new.seed,
        worlds=new.worlds,
        harm_count=new.harm_count,
        worlds_sha256=worlds_sha256(sample.worlds, sample.index),
        table_sha256=hashlib.sha256(table).hexdigest(),
        full_brake_harm=full_harm,
        best_known_harm=float(best.mean()),
    )
    return listed, table
