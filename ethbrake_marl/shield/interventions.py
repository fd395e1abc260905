"""The log of a step shield: every decision in which something else than the proposal was applied."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.shield.certify import Backup, Decision, Running


class Intervention(NamedTuple):
    """One decision in which something else than the proposal was applied."""

    world: int  # row of the batch
    episode: int  # of that row, from 0
    step: int  # number of the decision
    time_s: float
    proposed: float  # action, as it was given
    applied: float  # action
    reason: int  # place in REASONS
    bound: float  # m2/s2, from now on
    margin: float  # m2/s2; negative: what the proposal would have cost beyond the budget at least
    state: Floats  # [S] at the decision
    plan: Floats  # [L] that was held; before ``step`` what was applied


def interventions(
    now: Running, episode: Ints, proposed: Floats, decision: Decision, held: Backup
) -> list[Intervention]:
    """What a decision made from ``now`` replaced; ``episode`` [n] numbers the rows' episodes."""
    times, states = now.time_s, now.nominal().states
    return [
        Intervention(
            k, int(episode[k]), int(now.steps[k]), float(times[k]), float(proposed[k]), float(decision.applied[k]),
            int(decision.reason[k]), float(decision.bound[k]), float(decision.margin[k]), states[k].copy(),
            held.plan[k].copy(),
        )
        for k in np.flatnonzero(decision.intervened).tolist()
    ]  # fmt: skip


def write_down(log: list[Intervention], found: list[Intervention], now: Running, episode: Ints) -> None:
    """Add what was found at ``now`` to the log, in place of what an interrupted step may have left at its end."""
    while log and _is_undone(log[-1], now, episode):
        log.pop()
    log.extend(found)


def _is_undone(entry: Intervention, now: Running, episode: Ints) -> bool:
    """Whether the running episodes have not come as far as this entry."""
    k = entry.world
    return k < now.n and entry.episode == episode[k] and entry.step >= now.steps[k]
