"""Files of tunings as strangers write them; through Python always, by the command where Optuna is installed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from ethbrake_marl.studies.sweep import TuningPlan
from tests.hostile.case import Case, damaged, write
from tests.hostile.plan_cases import NOWHERE, of_every_file, of_own_keys

TUNING = """title: Two settings of the quick recipe
scenario: paper-random
recipe: quick
set: {total_steps: 256}
search:
  learning_rate.start: {low: 0.0001, high: 0.1, log: true}
  network.policy: {choices: [[8], [16, 8]]}
measure: {worlds: 10, seed: 11, times: 2}
prune: {after_trials: 2, after_times: 1}
sampler: {random_trials: 3}
"""

# Category -> what stands in the file, and what is put in its place; each is refused.
IN_TUNING: dict[str, tuple[str, tuple[str, ...]]] = {
    "scenario of a tuning": (
        "scenario: paper-random",
        tuple(f"scenario: {each}" for each in (*NOWHERE, "nobody", "7")),
    ),
    "recipe of a tuning": ("recipe: quick", tuple(f"recipe: {each}" for each in (*NOWHERE, "nobody", '"\\e[2J"'))),
    "settings of a tuning": (
        "{total_steps: 256}",
        ("{total_steps: 0}", "{gama: 1}", "{seed: 1}", "{learning_rate.start: 0.1}", '{"a=b": 1}', "[1]", "7"),
    ),
    "range of a setting": (
        "{low: 0.0001, high: 0.1, log: true}",
        (
            "{low: 0.1, high: 0.0001}",
            "{low: 0, high: 0.1, log: true}",
            "{low: .nan, high: 0.1}",
            "{low: 0.1, high: .inf}",
            "{low: 0.0001, high: 7}",
            "{low: true, high: 2}",
            "{low: x, high: y}",
            "{low: 0.1}",
            "{low: 0.1, high: 0.2, step: 1}",
            "{choices: [0.1]}",
            "{choices: [0.1, 0.1]}",
            "{choices: [0.1, x]}",
            "{choices: 7}",
            "[0.1, 0.2]",
            "7",
        ),
    ),
    "whole numbers": (
        "learning_rate.start: {low: 0.0001, high: 0.1, log: true}",
        tuple(
            f"{each}: {{low: {low}, high: {high}}}"
            for each in ("n_epochs", "n_envs")
            for low, high in ((1.0, 4.0), (1, 4.5))
        ),
    ),
    "searched setting": (
        "  learning_rate.start:",
        tuple(
            f"  {each}:" for each in ("nobody", "name", "__class__", "learning_rate.x", '"a=b"', '"\\u202e"', '""', "7")
        ),
    ),
    "measuring of a tuning": (
        "{worlds: 10, seed: 11, times: 2}",
        ("{worlds: 0}", "{worlds: 1000001}", "{times: 0}", "{times: 1001}", "{seed: -1}", "{file: x}", "7", "[1]"),
    ),
    "pruning": (
        "{after_trials: 2, after_times: 1}",
        ("{keep: 0}", "{keep: 1}", "{keep: .nan}", "{after_trials: -1}", "7"),
    ),
    "sampler": (
        "{random_trials: 3}",
        ("{name: nobody}", "{name: os.system}", "{seed: -1}", "{random_trials: 1e9}", "7"),
    ),
}


def tunings(rng: random.Random) -> Iterator[Case]:
    """4 of each way of every file, each of their own once, and damaged ones."""
    for category, content in (*of_every_file(rng, TUNING), *of_own_keys(TUNING, IN_TUNING)):
        yield _case(category, content)
    yield _case("too large", TUNING + "#" + "x" * (1 << 16))
    for _ in range(40):
        yield _case("damaged", damaged(rng, TUNING.encode()), certain=False)


def _case(category: str, content: bytes | str, *, certain: bool = True) -> Case:
    def build(folder: Path) -> None:
        write(folder / "mine.yaml", content)
        write(folder / "taken", "precious")

    command = ("study", "tune", "mine.yaml", "--output", "taken")
    read = (lambda: TuningPlan.read("mine.yaml")) if certain else None
    return Case("tuning", category, command, build, certain=certain, reader=read, content=content)
