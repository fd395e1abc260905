"""Bounds on how much faster than their common speed one of two vehicles in contact can be, and what that costs.

A *flight* is a time in which the two are apart. ``share`` is the partner's share of both masses. ``press`` is the
acceleration with which they close under the best command (m/s2); ``reach`` is how much of it a command can hold back.
``opening`` is the speed with which they separate. docs/internals/proofs/lower-bound.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.jit import compiled


@compiled
def flight_lead(share: float, press: float, reach: float, opening: float, flight: float) -> float:
    """Return the speed (m/s) that a flight gains for the controlled vehicle over the common speed of both, less its
    cost.

    A *flight* is a time in which the two vehicles are apart. For length L and opening speed o the lead over the common
    speed is ``share (press L - o) - G``. G is the least loss of command, at most ``reach`` per second, that keeps the
    two apart for L: ``G L - G^2 / (2 reach) >= (press L^2 / 2) - o L``. Returns -inf if nothing keeps them apart.

    Args:
        share: partner's share of both masses, 0 to 1.
        press: acceleration with which the two close under the best command, m/s2.
        reach: part of ``press`` that a command can hold back, m/s2; infinite: no bound.
        opening: speed with which the two separate, m/s.
        flight: length of the flight, s.

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
    """Return the length (s) of the flight with the largest ``flight_lead``; infinite if the lead keeps rising with the
    length.

    A *flight* is a time in which the two vehicles are apart.

    Args:
        share: partner's share of both masses, 0 to 1.
        press: acceleration with which the two close under the best command, m/s2.
        reach: part of ``press`` that a command can hold back, m/s2; infinite: no bound.
        opening: speed with which the two separate, m/s.

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

    A *flight* is a time in which the two vehicles are apart. The maximum is over all opening speeds up to ``opening``:
    a smaller one may lead further if flights are cut short.

    Args:
        share: partner's share of both masses, 0 to 1.
        press: acceleration with which the two close under the best command, m/s2.
        reach: part of ``press`` that a command can hold back, m/s2; infinite: no bound.
        opening: speed with which the two separate, m/s.
        shortest: least length of the flight, s.
        longest: largest length of the flight, s.
        lost: speed that is lost in any case, m/s.

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
    """Return whether it never pays to give up some acceleration in order to make a later bounce larger.

    If so, ``reach`` bounds the speed that the vehicle gains while the two are apart.

    Args:
        share: partner's share of both masses, 0 to 1.
        press: acceleration with which the two close under the best command, m/s2.
        reach: part of ``press`` that a command can hold back, m/s2; infinite: no bound.
        bounce: coefficient of restitution.

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
    """Return an upper bound (m/s) on how much faster the controlled vehicle is than the speed of both vehicles' centre
    of mass.

    Both vehicles have met already. The centre of mass is the one that the best command alone would lead to. In the
    *window* an earlier command still acts instead, which costs the speed ``lost``.

    The bound covers three cases: the last time apart before the meeting with the other neighbour began with the first
    impact, within the window, or after it.

    Args:
        share: partner's share of both masses, 0 to 1.
        press: acceleration with which the two close under the best command, m/s2.
        reach: part of ``press`` that a command can hold back, m/s2; infinite: no bound.
        bounce: coefficient of restitution.
        opening: speed with which the two separate, m/s.
        lost: speed that is lost in the window, m/s.
        late: start of the window, s.
        end: end of the window, s.
        since: earliest time of the meeting with the other neighbour, s.
        until: latest time of that meeting, s.

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
    """Return the largest ``sqrt(p^2 + 2 press s)`` (m/s) while a vehicle and a partner that brakes harder are apart.

    p is the speed with which the two separate, s their gap. Returns infinity if no bound is known.

    Args:
        share: partner's share of both masses, 0 to 1.
        slack: by how much the partner brakes harder, m/s2.
        press: acceleration with which the two close under the best command, m/s2.
        drive: largest acceleration by a command, m/s2.
        bounce: coefficient of restitution.
        closing: closing speed of the first impact, m/s.
        back: backward speed of the vehicle after that impact, m/s.
        time: time that is covered, s.

    """
    if not slack > 0.0 or not bounce * bounce * press < slack:
        return math.inf
    grow = bounce * bounce * press / slack
    roll = max(share * (1.0 + bounce) - 1.0, 0.0)
    return max(
        math.sqrt(grow * closing * closing + 2.0 * drive * back * time), 2.0 * drive * roll * time / (1.0 - grow)
    )
