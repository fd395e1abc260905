"""Scenarios and adversaries on which the step shield is tried."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.guard import ShieldOptions, guard_of
from ethbrake_marl.shield.step_shield import certify
from tests.shield.trained import trained

_ROLES = {
    3: {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "constant:5"},
    5: {
        "vehicle_1": "constant:6",
        "vehicle_2": "full_brake",
        "vehicle_3": "learner",
        "vehicle_4": "constant:4",
        "vehicle_5": "coast",
    },
}


def line(N: int, restitution: float = 0.3) -> Scenario:
    """Random lines of N vehicles, e from 0 to ``restitution``; the learner may also drive."""
    return Scenario(
        name=f"line-{N}",
        vehicles=N,
        gaps_m={"uniform": [2, 12]},
        speeds_mps={"uniform": [10, 20]},
        braking_capacity_mps2={"uniform": [6, 9]},
        driving_capacity_mps2={"uniform": [0, 4]},
        mass_t={"uniform": [1, 8]},
        latency_s={"uniform": [0, 0.7]},
        restitution={"uniform": [0, restitution]},
        roles=_ROLES[N],
        early_impacts="keep",
    )


class Attack(NamedTuple):
    """What an adversary achieved; n worlds."""

    realised: np.ndarray  # harm in the engine's ledger
    bound: np.ndarray  # at the alert
    last_bound: np.ndarray
    accepted: np.ndarray  # deviations from the plan that were let through
    decisions: int


def random_actions(rng, engine, k):
    return rng.uniform(-1.0, 1.0, engine.n)


def extremes(rng, engine, k):
    return np.where((k + np.arange(engine.n)) % 2, 1.0, -1.0)


def full_drive(rng, engine, k):
    return np.ones(engine.n)


def slow_drift(rng, engine, k):
    """Random, held for several steps: whole profiles that differ from the plan."""
    return np.random.default_rng(1_000 + k // 6).uniform(-1.0, 0.5, engine.n)


def worst_case(rng, engine, k):
    """Of eight candidates the accepted one that leaves the most harm: a search against the shield itself."""
    return most_harmful(rng, engine.guarded.shield)


def most_harmful(rng, shield, candidates=8):
    n = len(shield.first_bound)
    best, action = np.full(n, -1.0), np.full(n, 1.0)
    for candidate in np.linspace(-1.0, 1.0, candidates) + rng.uniform(-0.1, 0.1, candidates):
        decision = certify(shield.running, np.full(n, candidate), shield.backup, shield.bound)
        free = ~decision.intervened & (decision.reason != 0)
        better = free & (decision.bound > best)
        best[better], action[better] = decision.bound[better], np.clip(candidate, -1.0, 1.0)
    return action


ADVERSARIES = {f.__name__: f for f in (random_actions, extremes, full_drive, slow_drift, worst_case, trained)}


def attack(scenario: Scenario, worlds, adversary, *, harm_count="first", allowance=0.0, seed=0) -> Attack:
    """Let an adversary propose in every step; harm is read from the engine, not from the shield."""
    rng = np.random.default_rng(seed)
    learner = scenario.learners[0]
    scripts = {i: make_agent(spec) for i, spec in scenario.scripts.items()}
    options = ShieldOptions(harm_count=harm_count, allowance=allowance)
    engine = Engine(
        scenario, worlds.n, learners=(learner,), scripts=scripts, worlds=worlds,
        guard=lambda engine: guard_of(engine, None, options),
    )  # fmt: skip
    accepted, decisions, k = np.zeros(worlds.n, np.int64), 0, 0
    while not engine.ended.all():
        decisions += int((~engine.ended).sum())
        engine.step(adversary(rng, engine, k)[:, np.newaxis])
        reason = engine.ruling.decision.reason
        accepted += (reason == 1) | (reason == 2)
        k += 1
    shield = engine.guarded.shield
    assert not shield.distrusted.any()
    return Attack(engine.ledger.world_harm(harm_count), shield.first_bound, shield.bound, accepted, decisions)
