"""A search for a way past the bound, and the proof that it is strong enough to find one where there is one.

A restart is one random world and one random way to propose, step by step: at random, at the extremes, a constant held
for a random time, or what of some candidates the shield lets through at the greatest harm. The shield as it is must
keep every restart at or below its bound at the alert. The same restarts, against a shield with one planted leak
(``tests.shield.sabotage``), must find harm above the bound.

Why power is shown by leaks found: realised harm equals the last bound to the bit, so "came within 1 % of the bound" is
reached by proposing nothing but the plan. It says nothing about a search.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import StepShield
from tests.shield.lines import line, most_harmful
from tests.shield.sabotage import Leak

TOLERANCE = 1e-9  # m2/s2
BATCH = 250  # restarts that run together
WAYS = 4


class Found(NamedTuple):
    """What the restarts achieved."""

    restarts: int
    above: int  # restarts that ended above the bound at the alert
    first: int | None  # number of the first of them, from 1
    excess: float  # largest harm above the bound (m2/s2)
    loose: float  # share of the restarts that would end above the bound if their proposals were applied unshielded


def search(
    restarts: int, seed: int, leak: Leak | None = None, *, until_found: bool = False, harm_count="first"
) -> Found:
    """Attack the shield, or one with a leak, from many random starts."""
    above, first, excess, loose, done = 0, None, -np.inf, 0, 0
    while done < restarts and not (until_found and first is not None):
        n = min(BATCH, restarts - done)
        over, free = _batch(n, seed, done, leak, harm_count)
        broken = np.flatnonzero(over > TOLERANCE)
        if first is None and broken.size:
            first = done + int(broken[0]) + 1
        above, excess, loose = above + broken.size, max(excess, float(over.max())), loose + int((free > 0).sum())
        done += n
    return Found(done, above, first, excess, loose / done)


def _batch(n: int, seed: int, done: int, leak: Leak | None, harm_count) -> tuple[np.ndarray, np.ndarray]:
    """Harm above the bound at the alert, [n]: behind the shield, and with the same proposals applied as they are."""
    rng = np.random.default_rng([seed, done])
    scenario = line(3 if (done // BATCH) % 2 == 0 else 5)
    worlds = scenario.sample(n, seed, first=done).worlds
    shield, engine = StepShield(scenario, scenario.learners[0], harm_count=harm_count), _engine(scenario, worlds)
    shield.begin(worlds, np.arange(n))
    bound, way = shield.first_bound.copy(), rng.integers(WAYS, size=n)
    held, proposals, decision = rng.uniform(-1.0, 1.0, n), [], None
    while not engine.ended.all():
        if leak is not None:
            leak(shield, decision)
        held = np.where(rng.random(n) < 0.2, rng.uniform(-1.0, 1.0, n), held)
        tried = [rng.uniform(-1.0, 1.0, n), rng.choice([-1.0, 1.0], n), held, most_harmful(rng, shield, 6)]
        proposals.append(np.choose(way, tried))
        decision = shield.decide(proposals[-1], only=~engine.ended)
        engine.step(decision.applied[:, np.newaxis])
    free = _engine(scenario, worlds)
    for proposed in proposals:
        free.step(proposed[:, np.newaxis])
    while not free.ended.all():
        free.step(proposals[-1][:, np.newaxis])
    return engine.ledger.world_harm(harm_count) - bound, free.ledger.world_harm(harm_count) - bound


def _engine(scenario: Scenario, worlds) -> Engine:
    scripts = {i: make_agent(spec) for i, spec in scenario.scripts.items()}
    return Engine(scenario, worlds.n, learners=scenario.learners, scripts=scripts, worlds=worlds)
