"""Compiled: how much faster than the common speed of two touching vehicles one of them can be, and what that costs.

``share`` is the partner's share of both masses; ``press`` the acceleration with which they close under the best
command (m/s2), ``reach`` how much of it a command can hold back. docs/avoidability.md has the proofs.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.jit import compiled


@compiled
def flight_lead(share: float, press: float, reach: float, opening: float, flight: float) -> float:
    """How far ahead of the common speed a flight of this length can bring the controlled vehicle, less what it costs.

    ``share (press L - o) - G``, where G is the least loss of command, at most ``reach`` a second, that keeps the two
    apart for L: ``G L - G^2 / 2 reach >= press L^2 / 2 - o L``. -inf where nothing keeps them apart. [m/s]
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
    """The length of the flight of the largest ``flight_lead``; inf if it rises for ever."""
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
    """Largest ``flight_lead`` of lengths from ``shortest`` to ``longest``, of which ``lost`` is lost in any case.

    Of all openings up to ``opening``: where flights are cut short, a smaller one may lead further.
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
    """Whether no loss of command pays that makes a later bounce larger; ``reach`` then bounds what flights gain."""
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
    """How much faster than the common speed, without loss, it can be between ``since`` and ``until``. [m/s]

    The last flight before the rear meeting began with the first impact, after the window from ``late`` to ``end`` in
    which ``lost`` is lost, or within it. ``reach`` is inf where ``press`` is not constant.
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
    """Most of ``sqrt(p^2 + 2 press s)`` in every flight from a partner that brakes harder by ``slack``; inf if unknown.

    p is the speed with which the two part, s their gap. The first impact had ``closing`` and left the vehicle with
    speed ``-back``. All within ``time``; ``drive`` is the most that a command accelerates. [m/s]
    """
    if not slack > 0.0 or not bounce * bounce * press < slack:
        return math.inf
    grow = bounce * bounce * press / slack
    roll = max(share * (1.0 + bounce) - 1.0, 0.0)
    return max(
        math.sqrt(grow * closing * closing + 2.0 * drive * back * time), 2.0 * drive * roll * time / (1.0 - grow)
    )
