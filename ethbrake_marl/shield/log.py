"""The log of a step shield: every decision in which it replaced a proposed action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.state import Floats, Ints
from ethbrake_marl.shield.certify import Backup, Decision
from ethbrake_marl.shield.running import Running


class Intervention(NamedTuple):
    """One replaced action."""

    world: int  # row of the batch
    vehicle: int  # index of the shielded vehicle, 0 = front
    episode: int  # of that row, from 0
    step: int  # number of the decision
    time_s: float
    proposed: float  # action, as it was given
    applied: float  # action
    reason: int  # value of ShieldReason
    bound: float  # m2/s2, from now on
    margin: float  # m2/s2; negative: what the proposal would have cost beyond the budget at least
    state: Floats  # [S] at the decision
    plan: Floats  # [L] the plan at the decision, of several vehicles [L, K]; before ``step`` the applied actions


def interventions(
    now: Running, episode: Ints, vehicles: Sequence[int], proposed: Floats, decision: Decision, held: Backup
) -> list[Intervention]:
    """The actions that a decision replaced. ``now``: the episodes before it; ``episode`` [n]: their numbers."""
    times, states, shape = now.time_s, now.nominal().states, (now.n, len(vehicles))
    columns = (proposed, decision.applied, decision.reason, decision.margin, decision.intervened)
    given, applied, reason, margin, replaced = (np.reshape(column, shape) for column in columns)
    return [
        Intervention(
            k, vehicles[c], int(episode[k]), int(now.steps[k]), float(times[k]), float(given[k, c]),
            float(applied[k, c]), int(reason[k, c]), float(decision.bound[k]), float(margin[k, c]), states[k].copy(),
            held.plan[k].copy(),
        )
        for k, c in np.argwhere(replaced).tolist()
    ]  # fmt: skip
