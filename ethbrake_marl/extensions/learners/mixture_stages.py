"""Stages of training a mixture of experts: which updates train which of its networks."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan

ROUNDING = 1e-6  # tolerance for rounding in sums of shares, in updates


class Stage(NamedTuple):
    """One stage of training a mixture of experts: a range of updates, and what they train."""

    # The first expert (``alone``), a further expert, the gating network (``gate``), or all of them ``together``.
    does: Literal["alone", "further", "gate", "together"]
    network: int  # index of the expert that a stage ``further`` trains, from 1; 0 in other stages
    first: int  # first update, counted from 0
    end: int  # first update after the stage


def stages_of(plan: ExpertsPlan, updates: int) -> tuple[Stage, ...]:
    """Return the stages of a training with this number of updates, in order; a stage may be empty.

    ``plan`` is the key ``modes`` of the recipe, with the share of each stage.
    """
    shares, more = plan.shares, plan.networks - 1
    parts: list[tuple[Literal["alone", "further", "gate", "together"], int, float]] = [("alone", 0, shares.alone)]
    parts += [("further", k + 1, shares.further / more) for k in range(more)]
    parts += [("gate", 0, shares.gate), ("together", 0, shares.together)]
    found, done, first = [], 0.0, 0
    for does, network, share in parts:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        found.append(Stage(does, network, first, end))
        first = end
    return tuple(found)
