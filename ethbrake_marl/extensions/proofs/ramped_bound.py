"""Compute the lower bound on harm if brakes build up at finite rates.

``proofs/__init__.py`` explains the arguments that functions share.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.extensions.proofs.branch_and_bound import CELLS, NEAR, least_harm
from ethbrake_marl.extensions.proofs.line import (
    COMBINED_BOUND,
    FRONT_BOUND,
    LARGE,
    LINE,
    RAMPED_FRONT,
    RAMPED_REAR,
    REAR_BOUND,
    ROUGHLY,
    TOUCH_HARM,
    TOUCHING_M,
)
from ethbrake_marl.extensions.proofs.ramped_meetings import (
    fill_follower,
    fill_leader,
    gentlest_ramped,
    is_first_ramped,
    meet_ramped,
    onset_states,
)
from ethbrake_marl.extensions.proofs.ramps import empty_legs, meeting
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Worlds


@compiled(apart=True)
def combined_ramped(
    at: Floats, until: float, front: float, rear: float, contact_s: float, plan: Floats, other: Floats, heap: Floats
) -> float:
    """Return a lower bound (m2/s2) on the harm of both pairs together, with brake build-up.

    The first contact may be with the front or the rear vehicle. The result is 0 if nothing is proven. ``until`` is the
    horizon (s), after which harm does not count. ``front`` and ``rear`` are lower bounds on the harm of each pair alone
    (m2/s2). ``contact_s`` is the time by which some contact is certain, infinite if no contact is known to be certain.
    """
    if min(at[LINE.GAP_L], at[LINE.GAP_R]) <= TOUCHING_M:
        return 0.0
    fill_leader(at, plan)
    fill_follower(at, other)
    squeezed, closing, _ = meeting(
        at[LINE.GAP_L] + at[LINE.GAP_R], 0.0, at[LINE.V_L], plan, math.inf, at[LINE.V_R], other, math.inf, 0.0, math.inf
    )
    last, best = min(contact_s, squeezed), LARGE
    if not last < until:
        return 0.0
    for kind, sign, floor in ((RAMPED_FRONT, 1.0, rear), (RAMPED_REAR, -1.0, front)):
        first = meet_ramped(kind, at, sign, plan, other)[0]
        if first > last or not is_first_ramped(kind, at, first, plan, other):
            continue
        early, late = first, last
        if not is_first_ramped(kind, at, last, plan, other):
            for _ in range(ROUGHLY):
                middle = 0.5 * (early + late)
                if is_first_ramped(kind, at, middle, plan, other):
                    early = middle
                else:
                    late = middle
        best = least_harm(kind, at, first, late, floor, best, front + rear, plan, other, heap)
    if squeezed <= last:
        most = max(min(gentlest_ramped(RAMPED_FRONT, at, squeezed), closing), 0.5 * closing)
        best = min(best, most * most + (closing - most) * (closing - most))
    return best - TOUCH_HARM if best < LARGE else 0.0


@compiled
def bound_ramped(states: Floats, has_front: Bools, has_rear: Bools, both: Bools, out: Floats) -> None:
    """Compute lower bounds on the harm of ``n`` worlds with brake build-up: for each pair alone, and for both pairs
    together.

    The arguments are as in ``lower_bound.bound_worlds``. ``both`` [n] is True for worlds whose combined bound is
    computed; the combined bound is 0 in all other worlds.
    """
    plan, other, heap = empty_legs(), empty_legs(), np.empty((CELLS, NEAR))
    for k in range(states.shape[0]):
        at, contact_s = states[k], math.inf
        for kind, sign, there in ((RAMPED_FRONT, -1.0, has_front[k]), (RAMPED_REAR, 1.0, has_rear[k])):
            out[k, kind - RAMPED_FRONT] = 0.0
            if there:
                time, closing, least = meet_ramped(kind, at, sign, plan, other)
                bound = least * least if kind == RAMPED_FRONT else closing * closing
                contact_s = min(contact_s, time)
                if time < at[LINE.UNTIL] and bound > TOUCH_HARM:
                    out[k, kind - RAMPED_FRONT] = bound
        out[k, COMBINED_BOUND] = 0.0
        if both[k]:
            front, rear = out[k, FRONT_BOUND], out[k, REAR_BOUND]
            out[k, COMBINED_BOUND] = combined_ramped(at, at[LINE.UNTIL], front, rear, contact_s, plan, other, heap)


def ramped_states(worlds: Worlds, i: int, until: Floats) -> Floats:
    """Return worlds with brake build-up as an array with the columns of ``line.LINE``, [n, LINE.WIDTH].

    The worlds are in their state at the moment when the controlled vehicle ``i`` may act. ``until`` [n] is the horizon,
    in s from this moment. A controlled vehicle that already brakes or drives is treated as if its brakes built up and
    released at once.
    """
    v, at = worlds.vehicles, onset_states(worlds, i, None)
    moved = worlds.command_mps2[:, i] != 0.0
    at[:, LINE.FALL_F] = np.where(moved, np.inf, v.brake_rate_mps3[:, i])
    at[:, LINE.RISE_F] = np.where(moved, np.inf, v.release_rate_mps3[:, i])
    at[:, LINE.UNTIL] = until
    for j, force, fall in ((i - 1, LINE.FORCE_L, LINE.FALL_L), (i + 1, LINE.FORCE_R, LINE.FALL_R)):
        if 0 <= j < worlds.N:
            at[:, force], at[:, fall] = worlds.command_mps2[:, j], v.brake_rate_mps3[:, j]
    return at
