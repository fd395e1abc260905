"""An upper bound on the speed of a vehicle relative to the centre of mass of its pair after a first contact.

The *pair* is the controlled vehicle and its *partner*, the neighbour of its first contact. A *flight* is a period in
which the two are not in contact. Proofs: docs/proofs/harm.md.

- ``pair``: ``(share, press, reach, bounce)``. ``share``: mass of the partner divided by the mass of the pair, 0 to 1.
  ``press``: acceleration of the two towards each other under the extreme command (m/s2). ``reach``: largest amount by
  which another command can lower ``press`` (m/s2); infinite if no limit is known. ``bounce``: restitution.
- ``opening``: speed at which the two separate at the start of the flight (m/s).
- ``lost``: speed that the controlled vehicle loses because it cannot change its command right after the first contact
  (m/s).
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, large


@kernel
def flight_lead(pair, opening, flight):
    """*Lead* of a flight: the speed (m/s) that the controlled vehicle gains, minus the speed that it gives up.

    The gain is its speed minus the speed of the centre of mass of the pair. For a flight of L seconds (``flight``) with
    the opening speed o, the lead is ``share (press L - o) - G``. G is the speed (m/s) that the vehicle must give up to
    stay apart from its partner for the time L. It is the smallest G with ``G L - G^2 / (2 reach) >= (press L^2 / 2) - o
    L``, because the vehicle can give up at most ``reach`` in each second. The result is -inf if no command keeps the
    two apart for so long. ``share``, ``press`` and ``reach`` are elements of ``pair``, explained at the top of this
    file.
    """
    share, press, reach, _ = pair
    relative = share * (press * flight - opening)
    if press * flight <= 2.0 * opening:
        return relative
    if reach == math.inf:
        return relative - (0.5 * press * flight - opening)
    inside = reach * (reach - press) * flight * flight + 2.0 * reach * opening * flight
    return relative - reach * flight + math.sqrt(inside) if inside >= 0.0 else -math.inf


@kernel
def best_flight(pair, opening):
    """Duration (s) of the flight with the largest lead (``flight_lead``).

    It is infinite if a longer flight always has a larger lead. ``opening``: speed at which the two separate (m/s).
    ``pair``: top of this file.
    """
    share, press, reach, _ = pair
    if press <= 0.0:
        return math.inf
    if share <= 0.5:
        return 2.0 * opening / press
    if reach == math.inf:
        return math.inf
    slope = reach - share * press
    radicand = slope * slope - reach * (reach - press)
    if radicand <= 0.0:
        return math.inf
    root = math.sqrt(radicand)
    return max(reach * opening / (root * (slope + root)), 2.0 * opening / press)


@large
def lead(pair, opening, shortest, longest, lost):
    """Largest lead (m/s) of all flights that last from ``shortest`` to ``longest`` seconds (``flight_lead``).

    The maximum is over all speeds of separation up to ``opening`` (m/s), because in a limited time a smaller speed may
    give a larger lead. ``pair``, ``lost``: top of this file.
    """
    share, press, reach, _ = pair
    if press <= 0.0:
        return -lost
    opening = min(opening, 0.5 * press * longest)
    flight = best_flight(pair, opening)
    if lost > 0.0:
        total_opening = opening + lost
        flight = max(
            flight,
            (total_opening + math.sqrt(max(total_opening * total_opening - press * lost * lost / reach, 0.0))) / press,
        )
    flight = min(max(flight, shortest), longest)
    most = share * press * flight - lost
    if flight < longest:
        most -= share * opening
    return min(flight_lead(pair, opening, flight), most)


@kernel
def decays(pair):
    """Whether ``reach`` limits the speed that the controlled vehicle can gain in any flight.

    False if the vehicle may gain speed by accelerating less now and bouncing more strongly later. ``pair``, with
    ``reach``: top of this file.
    """
    share, press, reach, bounce = pair
    if share <= 0.5:
        return True
    if reach == math.inf or press <= 0.0:
        return False
    if reach > press:
        return bounce * (math.sqrt(reach / (reach - press)) - share) <= 1.0 - share
    return bounce * flight_lead(pair, 1.0, best_flight(pair, 1.0)) <= 1.0 - share


@large
def largest_lead(pair, opening, lost, late, end, since, until):
    """Upper bound (m/s) on the speed of the controlled vehicle minus the speed of the centre of mass of its pair.

    The centre of mass is taken to move as if the vehicle executed the extreme command from the first contact on. In
    reality the command of the earlier decision still applies in the *window*, the rest of the decision step from
    ``late`` to ``end``, and there the vehicle loses the speed ``lost``.

    The controlled vehicle touches its second neighbour, the one outside the pair, between ``since`` and ``until``. The
    pair's last flight before this begins with the first impact, within the window, or after the window; the bound is
    the maximum over these three cases. Times are in s after the first contact. ``pair``, ``opening``: top of this file.
    """
    share, press, reach, bounce = pair
    if since < end:
        lost, end = 0.0, late
    if not decays(pair):
        return lead((share, press, math.inf, bounce), opening, 0.0, until, lost)
    shortest = 0.0 if reach == math.inf else max(since - late, 0.0)
    longest = math.inf if share > 0.5 and reach <= press else until
    first = lead(pair, opening, shortest, longest, lost)
    again = bounce * (opening + lost)
    result = max(first, lead(pair, again, 0.0, longest, 0.0) - (1.0 - share) * lost)
    if lost > 0.0:
        gain = max((1.0 + bounce) * share - 1.0, 2.0 * share - 1.0)
        within = lead(pair, bounce * opening, 0.0, longest, 0.0) + gain * lost
        shortest = 0.0 if reach == math.inf else since - end
        within = min(within, lead(pair, again, shortest, longest, 0.0))
        result = max(result, min(within, share * press * until - (1.0 - share) * lost))
    return result


@kernel
def widest_flight(share, slack, press, drive, bounce, closing, back, time):
    """Upper bound (m/s) on ``sqrt(p^2 + 2 press s)`` in all flights from a partner that brakes harder.

    p is the speed (m/s) at which vehicle and partner separate, s the gap (m) between them. The bound holds for ``time``
    seconds; infinite: no bound is known. ``slack``: braking capacity of the partner minus the vehicle's (m/s2).
    ``drive``: the vehicle's largest acceleration (m/s2). ``closing``: closing speed of the first impact (m/s).
    ``back``: backward speed of the vehicle after this impact (m/s). Other arguments: top of this file.
    """
    if not slack > 0.0 or not bounce * bounce * press < slack:
        return math.inf
    grow = bounce * bounce * press / slack
    roll = max(share * (1.0 + bounce) - 1.0, 0.0)
    return max(
        math.sqrt(grow * closing * closing + 2.0 * drive * back * time), 2.0 * drive * roll * time / (1.0 - grow)
    )
