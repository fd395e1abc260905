"""Compute an upper bound on the speed of a vehicle relative to the centre of mass of its pair after a first contact.

Here the *pair* is the controlled vehicle and its *partner*, the neighbour of its first contact. A *flight* is a period
in which the two vehicles of the pair are not in contact. docs/internals/proofs/lower-bound.md has the proofs.

Arguments that several functions share:

- ``share``: mass of the partner divided by the mass of the pair, 0 to 1.
- ``press``: acceleration of the two vehicles towards each other under the extreme command (full drive or full braking),
  m/s2.
- ``reach``: largest amount by which another command can lower ``press``, m/s2; infinite if no limit is known.
- ``bounce``: coefficient of restitution.
- ``opening``: speed at which the two vehicles separate at the start of the flight, m/s.
- ``lost``: speed that the controlled vehicle loses because it cannot change its command right after the first contact,
  m/s.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.jit import compiled


@compiled
def flight_lead(share: float, press: float, reach: float, opening: float, flight: float) -> float:
    """Return the *lead* of a flight: the speed (m/s) that the controlled vehicle gains by the flight, minus the speed
    that it must give up for the flight.

    The gain is the speed of the controlled vehicle minus the speed of the centre of mass of the pair. For a flight that
    lasts L seconds (``flight``) and begins with the opening speed o (m/s), the lead is ``share (press L - o) - G``. G
    is the speed (m/s) that the controlled vehicle must give up so that the two vehicles stay apart for the time L: the
    smallest G with ``G L - G^2 / (2 reach) >= (press L^2 / 2) - o L``. In each second the controlled vehicle can give
    up at most ``reach`` m/s. The result is -inf if no command keeps the vehicles apart for the time L.
    """
    relative = share * (press * flight - opening)
    if press * flight <= 2.0 * opening:
        return relative
    if reach == math.inf:
        return relative - (0.5 * press * flight - opening)
    inside = reach * (reach - press) * flight * flight + 2.0 * reach * opening * flight
    if inside < 0.0:
        return -math.inf
    return relative - reach * flight + math.sqrt(inside)


@compiled
def best_flight(share: float, press: float, reach: float, opening: float) -> float:
    """Return the duration (s) of the flight with the largest ``flight_lead``; infinite if a longer flight always has a
    larger lead.
    """
    if press <= 0.0:
        return math.inf
    if share <= 0.5:
        return 2.0 * opening / press
    if reach == math.inf:
        return math.inf
    slope = reach - share * press
    left = slope * slope - reach * (reach - press)
    if left <= 0.0:
        return math.inf
    root = math.sqrt(left)
    return max(reach * opening / (root * (slope + root)), 2.0 * opening / press)


@compiled(apart=True)
def lead(
    share: float, press: float, reach: float, opening: float, shortest: float, longest: float, lost: float
) -> float:
    """Return the largest ``flight_lead`` (m/s) of all flights that last from ``shortest`` to ``longest`` seconds.

    The result is the maximum over all opening speeds up to ``opening``, because a smaller opening speed may lead to a
    larger result if the duration of the flight is limited.
    """
    if press > 0.0:
        opening = min(opening, 0.5 * press * longest)
    flight = best_flight(share, press, reach, opening)
    if lost > 0.0 and press > 0.0:
        both = opening + lost
        flight = max(flight, (both + math.sqrt(max(both * both - press * lost * lost / reach, 0.0))) / press)
    flight = min(max(flight, shortest), longest)
    most = share * press * flight - lost if press > 0.0 else -lost
    if flight < longest and press > 0.0:
        most -= share * opening
    return min(flight_lead(share, press, reach, opening, flight), most) if press > 0.0 else most


@compiled
def decays(share: float, press: float, reach: float, bounce: float) -> bool:
    """Return False if the controlled vehicle may gain speed in the following way: it accelerates less now, and
    therefore bounces more strongly off its partner later.

    If the result is True, ``reach`` limits the speed that the vehicle can gain in any flight.
    """
    if share <= 0.5:
        return True
    if reach == math.inf or press <= 0.0:
        return False
    if reach > press:
        return bounce * (math.sqrt(reach / (reach - press)) - share) <= 1.0 - share
    return bounce * flight_lead(share, press, reach, 1.0, best_flight(share, press, reach, 1.0)) <= 1.0 - share


@compiled(apart=True)
def largest_lead(
    share: float, press: float, reach: float, bounce: float, opening: float, lost: float, late: float, end: float,
    since: float, until: float,
) -> float:  # fmt: skip
    """Return an upper bound (m/s) on the speed of the controlled vehicle minus the speed of the centre of mass of the
    pair.

    The motion of the centre of mass is computed as if the controlled vehicle executed the extreme command from the
    first contact on. In reality, the command of the earlier decision still applies in the *window*, the rest of the
    decision step of the first contact. The window lasts from ``late`` to ``end``; in the window the controlled vehicle
    loses the speed ``lost``. ``opening`` is the speed at which the pair separates after the first contact.

    The bound is the maximum over three cases: the last flight before the contact with the neighbour outside the pair
    begins with the first impact, begins within the window, or begins after the window. The contact with the neighbour
    outside the pair comes between ``since`` and ``until``. All times are in s after the first contact.
    """
    if since < end:
        lost, end = 0.0, late
    if not decays(share, press, reach, bounce):
        return lead(share, press, math.inf, opening, 0.0, until, lost)
    shortest = 0.0 if reach == math.inf else max(since - late, 0.0)
    longest = math.inf if share > 0.5 and reach <= press else until
    first = lead(share, press, reach, opening, shortest, longest, lost)
    again = bounce * (opening + lost)
    result = max(first, lead(share, press, reach, again, 0.0, longest, 0.0) - (1.0 - share) * lost)
    if lost > 0.0:
        gain = max((1.0 + bounce) * share - 1.0, 2.0 * share - 1.0)
        within = lead(share, press, reach, bounce * opening, 0.0, longest, 0.0) + gain * lost
        shortest = 0.0 if reach == math.inf else since - end
        within = min(within, lead(share, press, reach, again, shortest, longest, 0.0))
        result = max(result, min(within, share * press * until - (1.0 - share) * lost))
    return result


@compiled
def widest_flight(
    share: float, slack: float, press: float, drive: float, bounce: float, closing: float, back: float, time: float
) -> float:
    """Return the largest value of ``sqrt(p^2 + 2 press s)`` (m/s) during the flights of the controlled vehicle and a
    partner that brakes harder than this vehicle.

    Here p is the speed (m/s) at which vehicle and partner separate, and s is the gap (m) between them. The result holds
    for ``time`` seconds; it is infinite if no bound is known. ``slack`` is the braking capacity of the partner minus
    the braking capacity of the controlled vehicle (m/s2). ``drive`` is the largest acceleration that the controlled
    vehicle can command (m/s2). ``closing`` is the closing speed of the first impact, and ``back`` the backward speed of
    the controlled vehicle after it (m/s).
    """
    if not slack > 0.0 or not bounce * bounce * press < slack:
        return math.inf
    grow = bounce * bounce * press / slack
    roll = max(share * (1.0 + bounce) - 1.0, 0.0)
    return max(
        math.sqrt(grow * closing * closing + 2.0 * drive * back * time), 2.0 * drive * roll * time / (1.0 - grow)
    )
