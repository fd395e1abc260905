"""The log of a step shield, which lists every proposed action that the shield replaced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.shields.certify import Backup, Decision
from ethbrake_marl.first_edition.shields.running import Running


class Intervention(NamedTuple):
    """Log entry: one proposed action that the shield replaced."""

    world: int  # row of the world in the batch
    vehicle: int  # index of the shielded vehicle, 0 = front
    episode: int  # number of the episode in that row, from 0
    step: int  # number of the decision in the episode, from 0
    time_s: float  # time of the decision since the alert (s)
    proposed: float  # proposed action, before clipping to [-1, 1]
    applied: float  # applied action, in [-1, 1]
    reason: int  # code of ShieldReason
    bound: float  # bound after this decision (m2/s2)
    margin: float  # margin of the proposal (m2/s2); negative: rejected
    state: Floats  # [S] state at the decision, in the layout of ``Running.states``
    plan: Floats  # [L], or [L, K] for K vehicles: plan before the decision; entries before ``step``: applied actions


def interventions(
    now: Running, episode: Ints, vehicles: Sequence[int], proposed: Floats, decision: Decision, held: Backup
) -> list[Intervention]:
    """Return one log entry for each action that a decision replaced.

    ``now`` are the n episodes before the decision, and ``held`` the plans before the decision. ``episode`` [n] are the
    numbers of the episodes, ``vehicles`` the indices of the K shielded vehicles, and ``proposed`` [n] or [n, K] the
    proposed actions.
    """
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
