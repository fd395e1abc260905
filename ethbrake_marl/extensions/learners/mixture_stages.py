"""Stages of training a mixture of experts: which networks each update trains."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan

ROUNDING = 1e-6  # tolerance for rounding in sums of shares, in updates


Trains = Literal["first", "other", "gating", "joint"]


class Stage(NamedTuple):
    """One stage of training a mixture of experts: a range of updates, and the networks that these updates train."""

    trains: Trains  # the first expert, one of the others, the gating network, or all networks jointly
    network: int  # index of the expert that a stage ``other`` trains, 1 or more; 0 in all other stages
    first: int  # number of the stage's first update, counted from 0
    end: int  # number of the first update after the stage


def stages_of(plan: ExpertsPlan, updates: int) -> tuple[Stage, ...]:
    """Return the stages of a training run of ``updates`` updates. A stage with a small share may get no updates."""
    shares, others = plan.shares, plan.networks - 1
    parts: list[tuple[Trains, int, float]] = [("first", 0, shares.pretraining_first)]
    parts += [("other", k + 1, shares.pretraining_others / others) for k in range(others)]
    parts += [("gating", 0, shares.gating), ("joint", 0, shares.joint)]
    stages, done, first = [], 0.0, 0
    for trains, network, share in parts:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        stages.append(Stage(trains, network, first, end))
        first = end
    return tuple(stages)
