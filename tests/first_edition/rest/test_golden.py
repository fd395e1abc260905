"""Bits that stay what they are: final states and harm of the physics, sampled worlds, decisions of the single shield.

``python -m tests.golden.test_golden`` writes the files of the physics and of the scenarios anew. A hash of the physics
changes only with the physics or the order of its floating point operations; the sums beside it tell which of the two.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.first_edition.evaluation.identity import worlds_sha256
from ethbrake_marl.first_edition.game.harm import empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.catalogue import list_scenarios, load_scenario
from ethbrake_marl.first_edition.shields.step import StepShield
from tests.first_edition.physics.random_worlds import Draws, driving_lines
from tests.first_edition.shield.attacks import line

GOLDEN = Path(__file__).with_name("physics_worlds.json")
LINES = {  # by name: vehicles and worlds
    "all": {2: 2_000, 3: 6_000, 5: 1_500, 10: 450, 50: 50},
    "few": {2: 60, 3: 90, 5: 40, 10: 8, 50: 2},  # for runs without compilation
}
UNTIL_S = (0.1, 0.2, 0.7, 1.3, 2.0, 4.0, 8.0)  # the command changes at each

SCENARIO_WORLDS = Path(__file__).with_name("scenario_worlds.json")
WORLDS = 1_000

DECISIONS = {"paper": "e588aa78dd473755", "five vehicles": "ce8815bf25435b2b", "obstacle": "e97447f43f026090"}
SHIELDS = {
    "paper": lambda: (StepShield(load_scenario("paper-random"), 1), 60),
    "five vehicles": lambda: (StepShield(line(5), 2, harm_count="total"), 40),
    "obstacle": lambda: (StepShield(load_scenario("paper-random-obstacle"), 1, harm_count="total"), 40),
}


def run(N: int, n: int) -> tuple[Floats, ...]:
    """Final gaps and speeds, harm by both counts, and impacts, of ``n`` lines of ``N`` vehicles."""
    worlds, _ = driving_lines(1_000 + N, n, N)
    draws = Draws(2_000 + N)
    ledger = empty_ledger(worlds)
    for until in UNTIL_S:
        worlds, impacts = advance(worlds, draws.uniform(-8.0, 3.0, (n, N)), until_s=until)
        ledger = ledger.add(impacts)
    count = ledger.count.astype(np.float64)
    return worlds.gaps_m, worlds.speeds_mps, ledger.pair_harm("first"), ledger.pair_harm("total"), count


def figures(name: str = "all") -> dict[str, str | int | float]:
    """The hash over the little-endian bytes of all columns, and rounded sums over all worlds."""
    digest = hashlib.sha256()
    results = [run(N, n) for N, n in LINES[name].items()]
    for columns in results:
        for column in columns:
            digest.update(np.ascontiguousarray(column, "<f8").tobytes())
    gaps, speeds, first, total, count = (sum(float(columns[k].sum()) for columns in results) for k in range(5))
    return {
        "worlds": sum(LINES[name].values()),
        "sha256": digest.hexdigest(),
        "impacts": int(count),
        "first_impact_harm_m2ps2": round(first, 2),
        "total_harm_m2ps2": round(total, 2),
        "gaps_m": round(gaps, 2),
        "speeds_mps": round(speeds, 2),
    }


@pytest.mark.parametrize("name", LINES)
def test_physics__worlds_have_the_committed_bits(name: str) -> None:
    assert figures(name) == json.loads(GOLDEN.read_text("utf-8"))[name]


def sampled(name: str) -> dict[str, Any]:
    """What is known of the first worlds of a shipped scenario."""
    scenario = load_scenario(name)
    lists = {"list": scenario.sample(WORLDS, 7), "training": scenario.sample(WORLDS, 0, channel="training")}
    return {
        channel: {"rejected": sample.rejected, "sha256": worlds_sha256(sample.worlds, sample.index)}
        for channel, sample in lists.items()
    }


@pytest.mark.parametrize("name", [entry.name for entry in list_scenarios()])
def test_scenario__worlds_are_what_they_were(name: str) -> None:
    assert sampled(name) == json.loads(SCENARIO_WORLDS.read_text())[name]


def decisions_hash(shield: StepShield, worlds: int) -> str:
    """A hash of all that is decided about random proposals, some of them beyond the range or no number."""
    shield.begin(shield.scenario.sample(worlds, 3).worlds, np.arange(worlds))
    rng, digest = np.random.default_rng(0), hashlib.sha256(shield.memory.first_bound.tobytes())
    while not shield.memory.running.finished.all():
        proposed = np.where(rng.random(worlds) < 0.05, np.nan, rng.uniform(-1.2, 1.2, worlds))
        decision = shield.decide(proposed)
        for column in (decision.applied, decision.reason, decision.bound, decision.margin, decision.intervened):
            digest.update(np.ascontiguousarray(column).tobytes())
        after = decision.after  # without the forces, which mean nothing where brakes are there at once
        digest.update(np.ascontiguousarray(after.states[:, : -after.problem.mass.shape[1]]).tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("name", SHIELDS)
def test_shield__decisions_have_the_committed_bits(name: str) -> None:
    assert decisions_hash(*SHIELDS[name]()) == DECISIONS[name]


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({name: figures(name) for name in LINES}, indent=2) + "\n")
    scenarios = {entry.name: sampled(entry.name) for entry in list_scenarios()}
    SCENARIO_WORLDS.write_text(json.dumps(scenarios, indent=1, sort_keys=True) + "\n")
