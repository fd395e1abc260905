"""Speed of the step shield: ``.venv/bin/python docs/studies/shield_speed.py [DECISIONS]``.

Prints the decisions per second of a batch, the time of one decision, and the time of one decision with a learned policy
behind the shield. Measure single decisions on idle cores.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.agents.driving import episode_engine
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.certify import certify
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.step import StepShield

SCENARIO = load_scenario("paper-random")


def batch_rate(intervals: str | None, n: int) -> tuple[float, int]:
    """Return decisions per second of a batch of ``n`` worlds with random proposals, and the members per world."""
    shield = RobustShield(SCENARIO, 1, uncertainty=None if intervals is None else parse_uncertainty(intervals))
    shield.begin(SCENARIO.sample(n, 3).worlds, np.arange(n))
    rng = np.random.default_rng(0)
    shield.decide(rng.uniform(-1.0, 1.0, n))
    done, start = 0, time.process_time()
    while not shield.memory.running.finished.all():
        done += int((~shield.memory.running.finished).sum())
        shield.decide(rng.uniform(-1.0, 1.0, n))
    return done / (time.process_time() - start), shield.memory.running.members


def single_times(decisions: int) -> list[float]:
    """Return the wall-clock seconds of each decision."""
    rng, took = np.random.default_rng(0), []
    while len(took) < decisions:
        shield = StepShield(SCENARIO, 1)
        shield.begin(SCENARIO.sample(1, 3, first=len(took)).worlds, np.arange(1))
        while not shield.memory.running.finished.all():
            proposed = rng.uniform(-1.0, 1.0, 1)
            begun = time.perf_counter()
            decision = certify(shield.memory.running, proposed, shield.memory.backup, shield.bound)
            took.append(time.perf_counter() - begun)
            shield.memory = shield.memory._replace(running=decision.after, backup=decision.backup)
    return took


def policy_times(decisions: int, later: bool) -> list[float]:
    """Return the processor seconds of each decision of a learned policy behind the shield, one world at a time.

    ``later``: the setting ``later_rollouts`` of the shield.
    """
    (policy,) = make_agents(["ppo"], SCENARIO).values()
    took: list[float] = []
    world = 0
    while len(took) < decisions:
        driver = ShieldedDriver(policy, SCENARIO, later_rollouts=later)
        engine = episode_engine(SCENARIO.sample(1, 3, first=world).worlds, driver, SCENARIO, 1)
        while not engine.ended.all():
            nothing, begun = np.full((1, 1), np.nan), time.process_time()
            engine.guard.decide(engine, engine.guarded, nothing)  # changes nothing
            took.append(time.process_time() - begun)
            engine.step({})
        world += 1
    return took


def main(decisions: int = 5_000) -> None:
    """Print one line per measurement."""
    for intervals, n in ((None, 4096), ("gaps_m=0.5", 1000), ("braking_capacity_mps2=10%,gaps_m=0.5", 1000)):
        rate, members = batch_rate(intervals, n)
        print(f"{members} members per world ({intervals or 'step mode'}): {rate:,.0f} decisions/s batched", flush=True)
    for label, took in (
        ("one decision", single_times(decisions)),
        ("one decision with ppo, inference included, with later rollouts", policy_times(decisions, True)),
        ("one decision with ppo, inference included, without later rollouts", policy_times(decisions, False)),
    ):
        middle, slow = np.quantile(took, [0.5, 0.99]) * 1e6
        print(f"{label}: p50 {middle:.0f} us, p99 {slow:.0f} us", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
