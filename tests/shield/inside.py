"""Worlds drawn from the inside of boxes against robust mode: ``coast`` is proposed in each decision.

What robust mode applies does not depend on which world of the box is the true one. So one shield decides for a box, and
many worlds of it are driven by what it applied.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield.step_shield import StepShield, begin_running, plan_harm
from ethbrake_marl.shield.uncertainty import parse_uncertainty

BATCH = 50_000  # worlds driven at once


class Inside(NamedTuple):
    """What one kind of robust mode did; means over boxes, or over the worlds drawn from them."""

    worlds: int  # drawn
    above: int  # realise more than the bound at the alert
    excess: float  # largest, m2/s2; below 0 where none is above
    bound: float  # at the alert, m2/s2
    harm: float  # realised, m2/s2
    replaced: float  # share of decisions
    seconds: float  # of processor time per decision


def inside(robust: str, intervals: str, boxes: int, draws: int, seed: int) -> Inside:
    """``draws`` worlds out of each of ``boxes`` boxes around worlds of ``paper-random``, behind one robust shield."""
    scenario, uncertainty = load_scenario("paper-random"), parse_uncertainty(intervals)
    told, rng = scenario.sample(boxes, seed).worlds, np.random.default_rng(seed)
    shield = StepShield(scenario, 1, uncertainty=uncertainty, robust=robust)
    shield.begin(told, np.arange(boxes))
    decisions, begun = 0, time.process_time()
    while not shield.running.finished.all():
        decisions += int((~shield.running.finished).sum())
        shield.decide(np.zeros(boxes))
    took, above, excess, harm = time.process_time() - begun, 0, -np.inf, 0.0
    for k in range(boxes):
        for first in range(0, draws, BATCH):
            n = min(BATCH, draws - first)
            truth = uncertainty.draw(told.take(np.full(n, k)), rng)
            plan = np.repeat(shield.backup.plan[k : k + 1], n, axis=0)
            realised = plan_harm(begin_running(profile_problem(truth, [1], horizon_s=scenario.horizon_s)), plan)
            over = realised - shield.first_bound[k]
            above, excess, harm = above + int((over > 1e-9).sum()), max(excess, over.max()), harm + realised.sum()
    return Inside(
        boxes * draws, above, float(excess), float(shield.first_bound.mean()), harm / (boxes * draws),
        float(shield.interventions.sum() / decisions), took / decisions,
    )  # fmt: skip


def inside_gate(intervals: str, boxes: int, draws: int, seed: int) -> bool:
    """Interior mode: none above, and no bound without a value. Corner mode beside it, which claims no such thing."""
    good = True
    for robust in ("corners", "interior"):
        found = inside(robust, intervals, boxes, draws, seed)
        good = good and (robust == "corners" or (found.above == 0 and np.isfinite(found.bound)))
        print(
            f"  {robust:8s} ({intervals}) {found.worlds:9,} worlds of {boxes} boxes  above: {found.above:,}, most"
            f" by {found.excess:.2g}; bound {found.bound:.2f}, harm {found.harm:.2f}, replaced {found.replaced:.0%},"
            f" {1e3 * found.seconds:.2f} ms per decision",
            flush=True,
        )
    return bool(good)
