"""Attacks on the joint shield of a team: one hostile learner, or all of them, at cooperation levels 3 and 4.

A hostile learner coasts, drives, jumps between extremes, says nothing that is a number, searches for what is let
through nearest to the bound, or copies the plan until it suddenly deviates. Who is not hostile proposes what the plan
says, or brakes fully. Harm is read from the engine's ledger, and compared with the bound as the same doubles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import StepShield
from ethbrake_marl.shield.step_shield import certify

SCENARIOS = {
    (3, 3): "cooperation-3-pair", (4, 3): "cooperation-4-all",
    (3, 5): "cooperation-3-five", (4, 5): "cooperation-4-five",
}  # fmt: skip
CAPS = (None, "baseline")
Proposals = Callable[[np.random.Generator, StepShield, int], np.ndarray]


class JointAttack(NamedTuple):
    """What a hostile team achieved; n worlds."""

    realised: np.ndarray  # harm in the engine's ledger
    bound: np.ndarray  # at the alert
    last_bound: np.ndarray
    rises: int  # how often the bound that was told rose
    over_cap: int  # vehicles that bore more than they might
    accepted: int  # deviations from the plan that were let through
    decisions: int


def coast(rng, shield, k):
    return np.zeros(shape(shield))


def full_drive(rng, shield, k):
    return np.ones(shape(shield))


def bang_bang(rng, shield, k):
    return np.sign(np.random.default_rng([k // 4, len(shield.first_bound)]).uniform(-1.0, 1.0, shape(shield)))


def speechless(rng, shield, k):
    """No number half of the time; at random else."""
    return np.where(rng.random(shape(shield)) < 0.5, np.nan, rng.uniform(-3.0, 3.0, shape(shield)))


def nearest(rng, shield, k):
    """Of some joint candidates the one that is let through and leaves the most harm."""
    best, action = np.full(len(shield.first_bound), -1.0), np.ones(shape(shield))
    for _ in range(4):
        candidate = rng.uniform(-1.0, 1.0, shape(shield))
        decision = certify(shield.running, candidate, shield.backup, shield.bound)
        better = (decision.reason != 3).any(axis=1) & (decision.bound > best)
        best[better], action[better] = decision.bound[better], candidate[better]
    return action


def sleeper(rng, shield, k):
    """What the plan says, for some decisions; then driving."""
    wakes = 3 + 4 * (np.arange(shape(shield)[0]) % 6)[:, np.newaxis]
    return np.where(k < wakes, planned(shield), 1.0)


ADVERSARIES: dict[str, Proposals] = {
    f.__name__: f for f in (coast, full_drive, bang_bang, speechless, nearest, sleeper)
}


def shape(shield: StepShield) -> tuple[int, int]:
    """Of a decision's proposals."""
    return len(shield.first_bound), len(shield.vehicles)


def planned(shield: StepShield) -> np.ndarray:
    """What the plan says now, [n, K]."""
    plan, rows = shield.backup.plan, np.arange(shape(shield)[0])
    return plan[rows, np.minimum(shield.running.steps, plan.shape[1] - 1)]


def joint_attack(
    scenario: Scenario, worlds, adversary: Proposals, *, hostile="all", harm_count="first", cap=None, seed=0
) -> JointAttack:
    """Let the hostile ones propose in every step: ``all``, or ``one`` learner, another one from world to world."""
    rng = np.random.default_rng(seed)
    scripts = {i: make_agent(spec) for i, spec in scenario.scripts.items()}
    engine = Engine(scenario, worlds.n, learners=scenario.learners, scripts=scripts, worlds=worlds)
    shield = StepShield(scenario, scenario.learners, harm_count=harm_count, cap=cap)
    shield.begin(worlds, np.arange(worlds.n))
    who = np.arange(worlds.n)[:, np.newaxis] % shape(shield)[1] == np.arange(shape(shield)[1])
    obeys = np.arange(worlds.n)[:, np.newaxis] % 4 < 2
    told, rises, accepted, decisions, k = shield.bound, 0, 0, 0, 0
    while not engine.ended.all():
        proposed = adversary(rng, shield, k)
        if hostile == "one":
            proposed = np.where(who, proposed, np.where(obeys, planned(shield), -1.0))
        decision = shield.decide(proposed, only=~engine.ended)
        decisions += int((~engine.ended).sum())
        accepted += int((((decision.reason == 1) | (decision.reason == 2)) & ~engine.ended[:, np.newaxis]).sum())
        rises, told = rises + int((decision.bound > told).sum()), decision.bound
        engine.step(decision.applied)
        k += 1
    ledger = engine.ledger
    over = 0 if cap is None else int((ledger.vehicle_harm(harm_count) > shield.baseline_shares).sum())
    realised = ledger.world_harm(harm_count)
    return JointAttack(realised, shield.first_bound, shield.bound, rises, over, accepted, decisions)


def scenario_of(level: int, N: int) -> Scenario:
    """The shipped scenario of a level, with N vehicles."""
    return load_scenario(SCENARIOS[level, N])
