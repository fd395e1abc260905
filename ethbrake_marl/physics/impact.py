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

from typing import NamedTuple

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import PLASTIC_SPEED_MPS, TOUCH_SPEED_MPS, settle
from ethbrake_marl.physics.worlds import Floats, Ints


class Cluster(NamedTuple):
    """Working memory for the impacts of one world, and their outcome."""

    closing: Floats  # [P] closing speed before, 0 where the pair does not touch
    before: Floats  # [N] speeds before
    work: Floats  # [2, N]
    block: Floats  # [4, N]
    struck: Ints  # [P] 1 where the pair had an impact (not a touch)


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
def resolve_cluster(speed: Floats, mass: Floats, restitution: float, first: int, last: int, cluster: Cluster) -> None:
    """Replace the speeds of touching vehicles ``first..last`` by their speeds after the impact, in place.

    One restitution holds per world, so clusters never mix two; the cluster is plastic when its largest closing speed
    is below ``PLASTIC_SPEED_MPS``. Speeds are taken relative to the front vehicle, which keeps the digits of small
    closing speeds.
    """
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, cluster.closing[p])
    bounce = restitution if largest >= PLASTIC_SPEED_MPS else 0.0
    reference = speed[first]
    relative, pooled = cluster.work[0], cluster.work[1]
    for i in range(first, last + 1):
        relative[i] = speed[i] - reference
    pool(relative, relative, mass, first, last, pooled, cluster.block)
    for i in range(first, last + 1):
        speed[i] = reference + (pooled[i] + bounce * (pooled[i] - relative[i]))


@compiled
def resolve_impacts(
    gap: Floats, speed: Floats, contact_speed: Floats, mass: Floats, restitution: float, cluster: Cluster
) -> bool:
    """One round of impacts of one world: every cluster that holds an approaching pair, once. False if there is none.

    ``contact_speed[p] > 0`` is the exact closing speed of a pair that has just met (else 0: the difference of the
    speeds counts). ``cluster`` receives each pair's closing speed and the speeds before, and which pairs struck.
    """
    pairs = gap.shape[0]
    touching = False
    for p in range(pairs):
        touching = touching or gap[p] <= 0.0
    if not touching:
        return False
    cluster.before[:] = speed
    for p in range(pairs):
        cluster.struck[p] = 0
        cluster.closing[p] = 0.0
        if gap[p] <= 0.0:
            cluster.closing[p] = contact_speed[p] if contact_speed[p] > 0.0 else speed[p + 1] - speed[p]
    resolved = False
    p = 0
    while p < pairs:
        last = p
        approaching = False
        while last < pairs and gap[last] <= 0.0:
            approaching = approaching or cluster.closing[last] > 0.0
            last += 1
        if approaching:
            resolved = True
            resolve_cluster(speed, mass, restitution, p, last, cluster)
            for q in range(p, last):
                cluster.struck[q] = 1 if cluster.closing[q] > TOUCH_SPEED_MPS else 0
        p = last + 1
    return resolved
