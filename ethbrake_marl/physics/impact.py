"""Impacts and resting contact of touching vehicles: one order-free law for both.

Pairs resolved one after another give results that depend on their order. Here a whole cluster of touching
vehicles is resolved at once by a mass-weighted isotonic regression ``P`` (pool adjacent violators):

* impact: ``v+ = (1 + e) P(v-) - e v-``; for two vehicles this is the paper's eq. (13);
* resting contact: accelerations are ``P`` of the vehicles' own ones, a block's common acceleration being
  ``sum(m u) / sum(m)``; forces that hold (brakes at rest) enter as a range, so a block at rest moves only when
  pushed harder than its braked members hold.

Vehicles are ordered front to rear; feasible means that no vehicle is faster than the one before it.
"""

from __future__ import annotations

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import PLASTIC_SPEED_MPS, TOUCH_SPEED_MPS, settle
from ethbrake_marl.physics.worlds import Floats, Ints


@compiled
def pool(low: Floats, high: Floats, mass: Floats, first: int, last: int, out: Floats, block: Floats) -> None:
    """Mass-weighted isotonic regression of vehicles ``first..last`` (inclusive), written to ``out``.

    ``block`` is scratch [4, N]: mass, force low, force high and first vehicle of each pooled block. All members of a
    block get the same bits.
    """
    count = 0
    for i in range(first, last + 1):
        block[0, count] = mass[i]
        block[1, count] = mass[i] * low[i]
        block[2, count] = mass[i] * high[i]
        block[3, count] = i
        out[count + first] = settle(low[i], high[i])
        while count > 0 and out[count + first] > out[count + first - 1]:
            count -= 1
            block[0, count] += block[0, count + 1]
            block[1, count] += block[1, count + 1]
            block[2, count] += block[2, count + 1]
            out[count + first] = settle(block[1, count] / block[0, count], block[2, count] / block[0, count])
        count += 1
    last_member = last
    for k in range(count - 1, -1, -1):
        value = out[k + first]
        start = int(block[3, k])
        for i in range(last_member, start - 1, -1):
            out[i] = value
        last_member = start - 1


@compiled
def resolve_cluster(
    speed: Floats, closing: Floats, mass: Floats, restitution: float, first: int, last: int, work: Floats, block: Floats
) -> None:
    """Replace the speeds of touching vehicles ``first..last`` by their speeds after the impact, in place.

    ``closing[p]`` is the closing speed of pair p; ``work`` is scratch [2, N]. One restitution holds per world, so
    clusters never mix two; the cluster is plastic when its largest closing speed is below ``PLASTIC_SPEED_MPS``.
    Speeds are taken relative to the front vehicle, which keeps the digits of small closing speeds.
    """
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, closing[p])
    bounce = restitution if largest >= PLASTIC_SPEED_MPS else 0.0
    reference = speed[first]
    for i in range(first, last + 1):
        work[0, i] = speed[i] - reference
    pool(work[0], work[0], mass, first, last, work[1], block)
    for i in range(first, last + 1):
        pooled = work[1, i]
        speed[i] = reference + (pooled + bounce * (pooled - work[0, i]))


@compiled
def resolve_impacts(
    gap: Floats,
    speed: Floats,
    contact_speed: Floats,
    mass: Floats,
    restitution: float,
    closing: Floats,
    before: Floats,
    work: Floats,
    block: Floats,
    struck: Ints,
) -> int:
    """One round of impacts of one world: every cluster that holds an approaching pair, once. Returns their number.

    ``contact_speed[p] > 0`` is the exact closing speed of a pair that has just met (else 0: the difference of the
    speeds counts). On return ``closing[p]`` is each pair's closing speed before, ``before`` the speeds before,
    ``struck[p]`` 1 where this was an impact (not a touch) and ``speed`` the speeds after.
    """
    pairs = gap.shape[0]
    clusters = 0
    for i in range(pairs + 1):
        before[i] = speed[i]
    for p in range(pairs):
        struck[p] = 0
        closing[p] = 0.0
        if gap[p] <= 0.0:
            closing[p] = contact_speed[p] if contact_speed[p] > 0.0 else speed[p + 1] - speed[p]
    p = 0
    while p < pairs:
        if gap[p] > 0.0:
            p += 1
            continue
        last = p
        approaching = False
        while last < pairs and gap[last] <= 0.0:
            approaching = approaching or closing[last] > 0.0
            last += 1
        if approaching:
            clusters += 1
            resolve_cluster(speed, closing, mass, restitution, p, last, work, block)
            for q in range(p, last):
                if closing[q] > TOUCH_SPEED_MPS:
                    struck[q] = 1
        p = last
    return clusters
