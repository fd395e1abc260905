"""At which times the first contact of the controlled vehicle can be with each neighbour.

Proof: docs/proofs/harm.md. Arguments: ``proofs/__init__.py``.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.avoidability import largest_behind, spare_gap
from ethbrake_marl.extensions.proofs.line import (
    A_F,
    A_L,
    A_R,
    FRONT_FIRST,
    GAP_L,
    GAP_R,
    HALVINGS,
    LIMIT_F,
    ONSET_R,
    REAR_FIRST,
    U_F,
    V_F,
    V_L,
    V_R,
)
from ethbrake_marl.extensions.proofs.meetings import (
    braking_to_rear,
    gentlest_front,
    meet_front,
    meet_rear,
    rest_of_rear,
    stays_ahead,
    stays_behind,
)
from ethbrake_marl.extensions.proofs.plans import braking, walk
from ethbrake_marl.motion.compiling import kernel, large

GRAZE_S = 1e-3  # largest rounding error in the time of a contact at closing speed 0


@kernel
def outer_contact(at):
    """Time (s) and squared closing speed (m2/s2) at which the rear vehicle would reach the front vehicle.

    The controlled vehicle between them is left out. Infinite and 0 if they never meet. ``at``: one world (columns: file
    ``line``).
    """
    rear = braking(at[ONSET_R], at[A_R])
    return walk(at[GAP_L] + at[GAP_R], at[V_L], braking(0.0, at[A_L]), at[V_R], rear, math.inf)[1:]


@large
def last_first(kind, at, first, last):
    """Latest time (s), at most ``last``, at which the first contact can be with the neighbour ``kind``.

    Found by bisection, from the time ``first`` (s), at which such a contact is possible. The later the contact with the
    front vehicle, the shorter the drive before it, and the nearer the rear vehicle comes. The later the contact with
    the rear vehicle, the shorter the braking before it, and the nearer the front vehicle comes. ``kind``, ``at``:
    package ``proofs``.
    """
    time = last
    for _ in range(HALVINGS + 1):
        if kind == FRONT_FIRST:
            is_first = stays_ahead(at, gentlest_front(at, time)[1], time)
        else:
            is_first = stays_behind(at, braking_to_rear(at, time), time)
        if is_first:
            first = time
        else:
            last = time
        if first == last:
            break
        time = 0.5 * (first + last)
    return first


@large
def last_meeting(at, first):
    """Latest time (s) of a contact with the front vehicle, and latest time (s) at which it can be the first contact.

    The third result is True if the first contact with the front vehicle may come arbitrarily late and at any closing
    speed. ``first`` is the earliest time (s) of a contact with the front vehicle. ``at``: one world (columns: file
    ``line``).
    """
    touches = spare_gap(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F]) >= 0.0
    last = meet_front(at, 0.0)
    if touches:
        last = largest_behind(at[GAP_L], at[V_L], at[A_L], at[V_F], at[A_F], at[U_F], at[LIMIT_F])[1]
    end = last_first(FRONT_FIRST, at, first, last)
    return last, end, touches and end == last


@large
def rear_times(at):
    """Times (s) of first contacts with the rear vehicle: first, last certain, latest, and latest at any closing speed.

    The contact is possible from the first time to the third. It comes by the second, unless the controlled vehicle can
    avoid it; if it can, and stays behind the front vehicle until then, the contact may also come from the second to the
    fourth time, at any closing speed. Otherwise the fourth time is the second. All are infinite if there is no such
    contact. ``at``: one world (columns: ``proofs/line.py``).
    """
    high = max(at[V_F] / at[A_F], rest_of_rear(at))
    first = meet_rear(at, high)
    if first == math.inf or not stays_behind(at, first, first):
        return math.inf, math.inf, math.inf, math.inf
    last, low, top = meet_rear(at, 0.0), 0.0, high
    avoids = last == math.inf
    if avoids:
        for _ in range(HALVINGS):
            middle = 0.5 * (low + top)
            if meet_rear(at, middle) < math.inf:
                top = middle
            else:
                low = middle
        last = meet_rear(at, top)
    end, late = last_first(REAR_FIRST, at, first, last), last
    if avoids and end >= last:
        # no first contact is possible after both have come to rest, or after the rear vehicle would reach the front one
        late = max(min(max(high, at[V_L] / at[A_L]), outer_contact(at)[0]), last) + GRAZE_S
    return first, last, end, late
