"""The shields of both editions side by side: interventions, mean harm, and processor time in one process.

``python -m tests.second.shields [WORLDS ...]`` prints a table; each figure is of the first edition, then of the second.
"""

import os
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.agents.learned import LearnedAgent as FirstAgent
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.policies.shipped import load_shipped as first_shipped
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario as load_first
from ethbrake_marl.first_edition.shields.options import ShieldOptions
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.game import game_of

LINES = (("paper-random", "first"), ("paper-random-obstacle", "total"), ("cooperation-3-pair", "first"))
WAYS = ("random", "drive", "brake", "ppo")


class Told(NamedTuple):
    """Sums over worlds."""

    seconds: float  # processor time of all steps
    decisions: int
    harm: float
    bound: float
    replaced: int


def proposed(way: str, rng: np.random.Generator, shape: tuple[int, int]) -> Any:
    return {"random": rng.uniform(-1.0, 1.0, shape), "drive": np.ones(shape), "brake": -np.ones(shape)}.get(way)


def first(name: str, count: str, way: str, n: int, begin: int = 0) -> Told:
    scenario, rng, spent, decisions = load_first(name), np.random.default_rng(begin), 0.0, 0
    policies: Any = {i: FirstAgent(first_shipped("ppo")) for i in scenario.learners} if way == "ppo" else {}
    engine = Engine(
        scenario, n, learners=scenario.learners, scripts=script_agents(scenario),
        worlds=scenario.sample(n, 7, first=begin).worlds,
        guard=lambda engine: ShieldOptions("step", harm_count=count).guard(engine, policies),  # type: ignore[arg-type]
    )  # fmt: skip
    while not engine.ended.all():
        actions = proposed(way, rng, (n, len(scenario.learners)))
        decisions += int((~engine.ended).sum())
        since = time.process_time()
        engine.step({} if actions is None else actions)
        spent += time.process_time() - since
    shield, harm = engine.guarded.shield, engine.ledger.world_harm(count)
    return Told(spent, decisions, harm.sum(), shield.memory.first_bound.sum(), int(shield.interventions.sum()))


def second(name: str, count: str, way: str, n: int, begin: int = 0) -> Told:
    (scenario, game), rng, spent, decisions = game_of(name), np.random.default_rng(begin), 0.0, 0
    learners = game.rules.learners.tolist()
    drivers = dict.fromkeys(learners, LearnedAgent(load_shipped("ppo"))) if way == "ppo" else None
    game = game._replace(shield=StepShield(drivers, harm_count=count))
    state = game.begin(scenario.sample(n, 7, first=begin))
    while not state.ended.all():
        actions = proposed(way, rng, (n, len(learners)))
        decisions += int((~state.ended).sum())
        since = time.process_time()
        state, _ = game.step(state, actions, donate=True)
        spent += time.process_time() - since
    memory, harm = state.memories["shield"], state.harm(count)
    return Told(spent, decisions, harm.sum(), memory.first.sum(), int(memory.replaced.sum()))


def both(name: str, count: str, way: str, n: int, times: int) -> tuple[Told, Told]:
    """Play both editions in turns, ``times`` batches of n worlds; both have compiled before."""
    sums = []
    for edition in (first, second):
        edition(name, count, way, min(n, 8), 99_000)
    for k in range(times):
        sums.append([edition(name, count, way, n, k * n) for edition in (first, second)])
    one, other = zip(*sums, strict=True)
    return tuple(Told(*(sum(column) for column in zip(*each, strict=True))) for each in (one, other))  # type: ignore[return-value]


def main(sizes: list[int]) -> None:
    for name, count in (*LINES, ("cooperation-4-all", "total")):
        for way in WAYS:
            for n in sizes:
                times = {1: 30, 64: 3}.get(n, 1)
                old, new = both(name, count, way, n, times)
                us = [each.seconds / each.decisions * 1e6 for each in (old, new)]
                print(
                    f"{name}, {count}, {way}, n = {n}: {us[0]:.1f} and {us[1]:.1f} us a decision, x{us[0] / us[1]:.2f};"
                    f" harm {old.harm / n / times:.3f} and {new.harm / n / times:.3f} ({new.harm / old.harm - 1:+.2%}),"
                    f" bound {old.bound / n / times:.3f} and {new.bound / n / times:.3f}, replaced"
                    f" {old.replaced / n / times:.2f} and {new.replaced / n / times:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    main([int(word) for word in sys.argv[1:]] or [1, 64, 2500])
