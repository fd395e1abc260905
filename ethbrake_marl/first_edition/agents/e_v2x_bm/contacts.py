"""First contact of a single pair in closed form, and the decelerations that avoid it.

The following table defines the symbols. docs/internals/proofs/constant-deceleration.md derives every formula.

=============  ========================================================================
l, f           leader (front vehicle), follower (rear vehicle)
gap            bumper to bumper at the start [m], >= 0
v_l, v_f       speeds at the start [m/s], >= 0
a_l, a_f       decelerations [m/s2], >= 0, constant to standstill
onset_l/_f     time from the start until the vehicle brakes [s]; until then it coasts
tau            time until the follower brakes, if the leader brakes from the start [s], >= 0
lead           time until the leader brakes, if the follower brakes from the start [s], > 0
w              closing speed ``v_f - v_l`` at the start [m/s]
=============  ========================================================================

The formulas use only + - * / and sqrt. Therefore the result for a world has the same bits in every batch of worlds.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND

TOUCH_SQUARED = (
    BOUND.TOUCH_SPEED_MPS * BOUND.TOUCH_SPEED_MPS
)  # contact at or below this squared closing speed: no impact

_NONE = -1.0


@compiled
def stopping_time(speed: float, deceleration: float) -> float:
    """Return the time (s) in which a vehicle stops: 0 if it is at rest, inf if it moves and does not brake."""
    if speed == 0.0:
        return 0.0
    return speed / deceleration


@compiled
def stopping_distance(speed: float, deceleration: float) -> float:
    """Return the distance (m) in which a vehicle stops: 0 if it is at rest, inf if it moves and does not brake."""
    if speed == 0.0:
        return 0.0
    return speed * speed / (2.0 * deceleration)


@compiled
def contact_while_coasting(gap: float, v_l: float, a_l: float, v_f: float, tau: float) -> float:
    """Return the squared closing speed (m2/s2) of a contact while the follower coasts; -1 if there is no such contact.

    docs/internals/proofs/constant-deceleration.md calls such a contact regime A if the leader still moves, and regime
    A' if the leader is at rest.
    """
    w = v_f - v_l
    stop_l = stopping_time(v_l, a_l)
    squared = w * w + 2.0 * a_l * gap
    time = math.inf
    if w > 0.0:
        time = 2.0 * gap / (w + math.sqrt(squared))
    elif a_l > 0.0:
        time = (math.sqrt(squared) - w) / a_l
    if time <= min(tau, stop_l):
        return squared
    if stop_l < tau and gap + stopping_distance(v_l, a_l) <= v_f * tau:
        return v_f * v_f
    return _NONE


@compiled
def contact_while_both_brake(gap: float, v_l: float, a_l: float, v_f: float, a_f: float, tau: float) -> float:
    """Return the squared closing speed (m2/s2) of a contact while both vehicles brake and move, otherwise -1.

    docs/internals/proofs/constant-deceleration.md calls such a contact regime B.
    """
    stop_l = stopping_time(v_l, a_l)
    if not stop_l > tau:
        return _NONE
    w_t = v_f - v_l + a_l * tau
    g_t = gap - (v_f - v_l) * tau - 0.5 * a_l * tau * tau
    q = a_f - a_l
    squared = w_t * w_t - 2.0 * q * g_t
    after = math.inf
    if w_t > 0.0:
        if squared >= 0.0:
            after = 2.0 * g_t / (w_t + math.sqrt(squared))
    elif q < 0.0:
        after = (math.sqrt(max(squared, 0.0)) - w_t) / -q
    if after < math.inf and tau + after <= min(stop_l, tau + stopping_time(v_f, a_f)):
        return squared
    return _NONE


@compiled
def contact_leader_first(gap: float, v_l: float, a_l: float, v_f: float, a_f: float, tau: float) -> float:
    """Return the squared closing speed (m2/s2) at the first contact if the leader brakes first; 0 without contact."""
    squared = contact_while_coasting(gap, v_l, a_l, v_f, tau)
    if squared < 0.0:
        squared = contact_while_both_brake(gap, v_l, a_l, v_f, a_f, tau)
    if squared >= 0.0:
        return squared
    room = gap + stopping_distance(v_l, a_l) - v_f * tau
    outlasts = tau + stopping_time(v_f, a_f) > stopping_time(v_l, a_l)
    if outlasts and stopping_distance(v_f, a_f) > room:  # regime C: the leader stands
        return v_f * v_f - 2.0 * a_f * room
    return 0.0


@compiled
def contact_before_leader_brakes(gap: float, w: float, a_f: float, lead: float) -> float:
    """Return the squared closing speed (m2/s2) if a braking follower hits a leader that still coasts, otherwise -1.

    The follower reaches the coasting leader at the time ``2 gap / (w + sqrt(w^2 - 2 a_f gap))``, if this time is at
    most ``lead``. A touch is ignored, because the two vehicles separate again after it.
    """
    squared = w * w - 2.0 * a_f * gap
    if w > 0.0 and squared > TOUCH_SQUARED and 2.0 * gap / (w + math.sqrt(squared)) <= lead:
        return squared
    return _NONE


@compiled
def closing_speed_squared(
    gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, a_f: float, onset_f: float
) -> float:
    """Return the squared closing speed (m2/s2) at the pair's first impact, or 0 if there is no impact."""
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        squared = w * w
    elif onset_l <= onset_f:
        squared = contact_leader_first(gap - w * both_coast, v_l, a_l, v_f, a_f, onset_f - onset_l)
    else:
        lead = onset_l - onset_f
        gap = gap - w * both_coast
        squared = contact_before_leader_brakes(gap, w, a_f, lead)
        if squared < 0.0:
            squared = 0.0
            if v_f > a_f * lead:
                gap = max(gap - (w - 0.5 * a_f * lead) * lead, 0.0)
                squared = contact_leader_first(gap, v_l, a_l, v_f - a_f * lead, a_f, 0.0)
    return squared if squared > TOUCH_SQUARED else 0.0


@compiled
def least_behind_braking(gap: float, v_l: float, a_l: float, v_f: float, tau: float) -> float:
    """Return ``least_to_spare_front`` (m/s2) if the leader brakes from the start; ``a_l`` is above 0."""
    coasting = contact_while_coasting(gap, v_l, a_l, v_f, tau)
    if coasting > TOUCH_SQUARED:
        return math.inf
    if v_f == 0.0 or coasting >= 0.0:
        return 0.0
    room = gap + stopping_distance(v_l, a_l) - v_f * tau
    if not room > 0.0:
        return math.inf
    to_stop = v_f * v_f / (2.0 * room)
    if tau + v_f / to_stop >= stopping_time(v_l, a_l):
        return to_stop
    w_t = v_f - v_l + a_l * tau
    g_t = gap - (v_f - v_l) * tau - 0.5 * a_l * tau * tau
    return a_l + w_t * w_t / (2.0 * g_t)


@compiled
def least_behind_coasting(gap: float, v_l: float, a_l: float, v_f: float, lead: float) -> float:
    """Return ``least_to_spare_front`` (m/s2) if the follower brakes from the start; ``a_l`` is above 0."""
    if v_f == 0.0:
        return 0.0
    w = v_f - v_l
    graze = 0.0
    if w > 0.0 and 2.0 * gap <= w * lead:
        graze = w * w / (2.0 * gap)
    to_stop = v_f * v_f / (2.0 * (gap + v_l * lead + stopping_distance(v_l, a_l)))
    if v_f / to_stop >= lead + stopping_time(v_l, a_l):
        return max(graze, to_stop)
    if graze > 0.0:
        return graze
    return (w * w + 2.0 * a_l * (gap - w * lead)) / (2.0 * gap - a_l * lead * lead)


@compiled
def least_to_spare_front(gap: float, v_l: float, a_l: float, onset_l: float, v_f: float, onset_f: float) -> float:
    """Return the follower's smallest deceleration (m/s2) that avoids an impact; inf if every deceleration leads to one.

    ``a_l`` must be above 0. With a larger deceleration the follower is further back at every moment. Therefore every
    larger deceleration avoids the impact as well. With the smallest deceleration that avoids an impact, the follower
    stops directly behind the leader, or the two vehicles touch with equal speeds while both move.
    """
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        return math.inf
    gap = gap - w * both_coast
    if onset_l <= onset_f:
        return least_behind_braking(gap, v_l, a_l, v_f, onset_f - onset_l)
    return least_behind_coasting(gap, v_l, a_l, v_f, onset_l - onset_f)


@compiled
def most_ahead_of_coasting(gap: float, v_l: float, v_f: float, a_f: float, tau: float) -> float:
    """Return ``most_to_spare_rear`` (m/s2) if the leader brakes from the start; ``a_f`` is above 0."""
    reach = v_f * tau + stopping_distance(v_f, a_f)
    touching = gap == 0.0 and v_f == v_l  # in contact from the start: no impact
    if reach <= gap or touching:
        return math.inf
    if v_l == 0.0:
        return -math.inf
    to_stop = v_l * v_l / (2.0 * (reach - gap))
    if tau + stopping_time(v_f, a_f) >= v_l / to_stop:
        return to_stop
    w = v_f - v_l
    graze = (2.0 * a_f * (gap - w * tau) - w * w) / (a_f * tau * tau + 2.0 * gap)
    return graze if graze >= 0.0 else -math.inf


@compiled
def most_to_spare_rear(gap: float, v_l: float, onset_l: float, v_f: float, a_f: float, onset_f: float) -> float:
    """Return the leader's largest deceleration (m/s2) that avoids an impact; inf if all avoid it, -inf if none does.

    ``a_f`` must be above 0. With a smaller deceleration the leader is further ahead at every moment. Therefore every
    smaller deceleration avoids the impact as well. If the follower brakes first, the motion until the leader brakes is
    computed first, because this motion does not depend on the leader's deceleration.
    """
    w = v_f - v_l
    both_coast = min(onset_l, onset_f)
    if w > 0.0 and gap <= w * both_coast:
        return -math.inf
    gap = gap - w * both_coast
    if onset_l <= onset_f:
        return most_ahead_of_coasting(gap, v_l, v_f, a_f, onset_f - onset_l)
    lead = onset_l - onset_f
    if contact_before_leader_brakes(gap, w, a_f, lead) >= 0.0:
        return -math.inf
    if v_f <= a_f * lead:
        return math.inf
    gap = max(gap - (w - 0.5 * a_f * lead) * lead, 0.0)
    return most_ahead_of_coasting(gap, v_l, v_f - a_f * lead, a_f, 0.0)
