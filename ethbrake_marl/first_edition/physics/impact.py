"""Impacts and resting contact of touching vehicles, resolved by one law for all pairs at once.

If pairs were resolved one after another, the result would depend on their order. This module therefore resolves all
impacts and pushes in a *cluster* (a sequence of touching vehicles) together. The law uses an operator P, the
mass-weighted isotonic regression (pool adjacent violators) of the vehicles' speeds or accelerations, from front to
rear. With the speeds v- before and v+ after the impact, and the restitution e:

* impact: ``v+ = (1 + e) P(v-) - e v-``; for two vehicles this is the paper's eq. (13);
* resting contact: the accelerations are ``P`` of the vehicles' own accelerations; a pooled block of vehicles with
  masses m and own accelerations u accelerates with ``sum(m u) / sum(m)``. The brakes of a vehicle at rest can have any
  force up to a limit. A block at rest therefore moves only if the push exceeds the braking force of its vehicles.

After the impact, no vehicle of a cluster is faster than the vehicle in front of it.

The argument ``table`` is one world in the layout of ``physics.rows``; ``first`` and ``last`` are the columns of the
front and the rear vehicle of a cluster; ``restitution``, in [0, 1], holds for every impact. All quantities are in one
array, because passing twenty small arrays from function to function would take more time than the physics.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND, settle
from ethbrake_marl.first_edition.physics.rows import LISTED, ROW
from ethbrake_marl.first_edition.physics.state import Floats


@compiled(bare=True)
def pool(table: Floats, low: int, high: int, first: int, last: int, out: int) -> int:
    """Compute the isotonic regression of the speeds or accelerations of touching vehicles; return the number of blocks.

    A vehicle whose value (speed or acceleration) is above the value of the vehicle in front forms a *block* with this
    vehicle. All vehicles of a block get the same value, the mean weighted by mass. Therefore no vehicle has a larger
    value than the vehicle in front of it. The function writes the vehicles' new values to row ``out``, and the blocks
    to the rows whose names begin with BLOCK. A vehicle of infinite mass (the obstacle) and its block get the value 0.

    The rows ``low`` and ``high`` contain a lower and an upper bound of each vehicle's own value (m/s or m/s2). They are
    the same row if the value is known exactly.
    """
    count = 0
    for i in range(first, last + 1):
        mass = table[ROW.MASS, i]
        table[ROW.BLOCK_MASS, count] = mass
        table[ROW.BLOCK_LOW, count] = mass * table[low, i] if mass < math.inf else 0.0
        table[ROW.BLOCK_HIGH, count] = mass * table[high, i] if mass < math.inf else 0.0
        table[ROW.BLOCK_FIRST, count] = i
        top = count + first
        table[out, top] = settle(table[low, i], table[high, i])
        while count > 0 and table[out, top] > table[out, top - 1]:
            count -= 1
            top -= 1
            table[ROW.BLOCK_MASS, count] += table[ROW.BLOCK_MASS, count + 1]
            table[ROW.BLOCK_LOW, count] += table[ROW.BLOCK_LOW, count + 1]
            table[ROW.BLOCK_HIGH, count] += table[ROW.BLOCK_HIGH, count + 1]
            mass = table[ROW.BLOCK_MASS, count]
            table[out, top] = settle(table[ROW.BLOCK_LOW, count] / mass, table[ROW.BLOCK_HIGH, count] / mass)
        count += 1
    member = last
    for k in range(count - 1, -1, -1):
        value = table[out, k + first]
        while member >= table[ROW.BLOCK_FIRST, k]:
            table[out, member] = value
            member -= 1
    return count


@compiled(bare=True)
def resolve_cluster(table: Floats, restitution: float, first: int, last: int) -> None:
    """Replace the speeds of the touching vehicles ``first..last`` by their speeds after the impact.

    The impact is plastic (restitution 0) if the largest closing speed is below ``PLASTIC_SPEED_MPS``. ``pool`` groups
    the vehicles into blocks and computes one common speed per block, as in a plastic impact. The function corrects this
    speed by the mean rounding error, so the error of the momentum is at most 4 machine epsilons times ``sum(m |v|)``
    for any masses. The speed of a vehicle that is not struck stays the same to the last bit.

    Rounding can make a corrected speed larger than the speed of the vehicle in front. In a plastic impact, the function
    therefore limits each speed to the speed of the vehicle in front. Otherwise two blocks could exchange a rounding
    error forever.
    """
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, table[ROW.CLOSING, p])
    bounce = restitution if largest >= BOUND.PLASTIC_SPEED_MPS else 0.0
    end = last + 1
    for block in range(pool(table, ROW.SPEED, ROW.SPEED, first, last, ROW.POOLED) - 1, -1, -1):
        head = int(table[ROW.BLOCK_FIRST, block])
        pooled = table[ROW.POOLED, head]
        if table[ROW.BLOCK_MASS, block] < math.inf:
            rest = 0.0
            for i in range(head, end):
                rest += table[ROW.MASS, i] * (table[ROW.SPEED, i] - pooled)
            pooled += rest / table[ROW.BLOCK_MASS, block]
        for i in range(head, end):
            table[ROW.SPEED, i] = pooled + bounce * (pooled - table[ROW.SPEED, i])
        end = head
    if bounce == 0.0:
        for i in range(first + 1, last + 1):
            table[ROW.SPEED, i] = min(table[ROW.SPEED, i], table[ROW.SPEED, i - 1])


@compiled(bare=True)
def resolve_impacts(table: Floats, restitution: float) -> bool:
    """Resolve once every cluster in which a pair has a closing speed above 0; return False if there is no such cluster.

    If the result is True, the function has updated row SPEED, written the rows CLOSING, BEFORE and STRUCK, and set row
    CONTACT_SPEED to 0.
    """
    pairs = table.shape[1] - 1
    approaching = False
    for p in range(pairs):
        closing = 0.0
        if table[ROW.GAP, p] <= 0.0:
            closing = table[ROW.CONTACT_SPEED, p]
            if closing == 0.0:
                closing = table[ROW.SPEED, p + 1] - table[ROW.SPEED, p]
        table[ROW.CLOSING, p] = closing
        approaching = approaching or closing > 0.0
    if not approaching:
        return False
    for i in range(pairs + 1):
        table[ROW.BEFORE, i] = table[ROW.SPEED, i]
    first = 0
    while first < pairs:
        last = first
        approaching = False
        while last < pairs and table[ROW.GAP, last] <= 0.0:
            approaching = approaching or table[ROW.CLOSING, last] > 0.0
            last += 1
        if approaching:
            resolve_cluster(table, restitution, first, last)
        first = last + 1
    for p in range(pairs):
        table[ROW.CONTACT_SPEED, p] = 0.0
        table[ROW.STRUCK, p] = 1.0 if table[ROW.CLOSING, p] > BOUND.TOUCH_SPEED_MPS else 0.0
    return True


@compiled(bare=True)
def record_impacts(table: Floats, time_s: float, world: int, rows: Floats, recorded: int) -> int:
    """Record the impacts that ``resolve_impacts`` resolved: add their harm to ``table``, write them to ``rows``.

    Returns ``recorded`` plus the number of these impacts.

    Args:
        table: one world to which ``resolve_impacts`` has been applied.
        time_s: time of the impacts, s.
        world: number of this world, written into ``rows``.
        rows: array to which the impacts are written, [capacity, LISTED.WIDTH]; if the array is full, further impacts
            are counted but not written.
        recorded: number of earlier impacts, including impacts that did not fit into ``rows``.

    """
    for p in range(table.shape[1] - 1):
        if table[ROW.STRUCK, p] == 0.0:
            continue
        closing = table[ROW.CLOSING, p]
        harm = closing * closing
        if recorded < rows.shape[0]:
            rows[recorded, LISTED.WORLD] = world
            rows[recorded, LISTED.PAIR] = p
            rows[recorded, LISTED.TIME] = time_s
            rows[recorded, LISTED.CLOSING] = closing
            rows[recorded, LISTED.FIRST] = 1.0 - table[ROW.HIT, p]
            rows[recorded, LISTED.FRONT_CHANGE] = table[ROW.SPEED, p] - table[ROW.BEFORE, p]
            rows[recorded, LISTED.REAR_CHANGE] = table[ROW.SPEED, p + 1] - table[ROW.BEFORE, p + 1]
        recorded += 1
        table[ROW.TOTAL_HARM, p] += harm
        table[ROW.COUNT, p] += 1.0
        if table[ROW.HIT, p] == 0.0:
            table[ROW.HIT, p] = 1.0
            table[ROW.FIRST_HARM, p] += harm
    return recorded
