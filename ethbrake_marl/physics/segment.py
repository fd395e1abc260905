"""One world through one segment of constant command: apart in closed form, else event by event.

Most segments bring no two vehicles near each other; each vehicle then moves on its own (``move_apart``). When two may
meet, touch or rest against each other, the world goes from event to event (``move_by_events``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import contact, drift, force_range, settle, solo_motion, speed_event
from ethbrake_marl.physics.impact import Cluster, pool, resolve_impacts
from ethbrake_marl.physics.worlds import Bools, Floats, Ints

PENETRATION_TOLERANCE_M = 1e-9  # a gap below minus this means that a contact was missed
MOST_EVENTS = 100_000  # per world and segment; reached only by a defect of the kernel
DONE, PENETRATED, STUCK = 0, 1, 2


class Line(NamedTuple):
    """One world: views of its row in the batch. ``gap`` and ``speed`` change, the rest is given."""

    gap: Floats  # [P]
    speed: Floats  # [N]
    command: Floats  # [N]
    onset: Floats  # [N] when the command takes effect, seconds from the start of the segment
    mass: Floats  # [N]
    limit: Floats  # [N]
    restitution: float


class Scratch(NamedTuple):
    """Working memory of one thread, reused for all its worlds."""

    onset: Floats  # [N]
    active: Bools  # [N] the latency has elapsed
    acceleration: Floats  # [N]
    force: Floats  # [2, N] range of each vehicle's own acceleration
    joined: Bools  # [P] the pair moves as one body
    speed_time: Floats  # [N] time to the next speed event
    speed_value: Floats  # [N] the speed there
    contact_time: Floats  # [P]
    contact_speed: Floats  # [P] closing speed at a contact that is due, else 0
    cluster: Cluster


class Tally(NamedTuple):
    """Where impacts are written: one world's row of each array, and the shared table of impacts."""

    hit: Bools  # [P]
    first_harm: Floats  # [P]
    total_harm: Floats  # [P]
    count: Ints  # [P]
    rows: Floats  # [capacity, 7]


@compiled
def make_scratch(vehicles: int) -> Scratch:
    """Working memory for lines of this many vehicles."""
    pairs = vehicles - 1
    cluster = Cluster(
        np.empty(pairs), np.empty(vehicles), np.empty((2, vehicles)), np.empty((4, vehicles)), np.empty(pairs, np.int64)
    )
    return Scratch(
        np.empty(vehicles), np.empty(vehicles, np.bool_), np.empty(vehicles), np.empty((2, vehicles)),
        np.empty(pairs, np.bool_), np.empty(vehicles), np.empty(vehicles), np.empty(pairs), np.zeros(pairs), cluster,
    )  # fmt: skip


@compiled
def move_apart(gaps: Floats, speeds: Floats, k: int, line: Line, duration: float, scratch: Scratch) -> bool:
    """Move a world whose vehicles surely stay apart; do nothing and return False when that is not sure.

    Speeds are monotone within a segment, so a pair closes by at most ``(max rear speed - min front speed) T``.
    """
    vehicles = speeds.shape[1]
    speed_after, way = scratch.speed_time, scratch.speed_value
    for i in range(vehicles):
        speed = speeds[k, i]
        if speed < 0.0:
            return False
        after, distance = solo_motion(speed, line.command[i], line.onset[i], line.limit[i], duration)
        speed_after[i] = after
        way[i] = distance
        if i > 0:
            closing = max(speed, after) - min(speeds[k, i - 1], speed_after[i - 1])
            if closing > 0.0 and closing * duration >= gaps[k, i - 1]:
                return False
    for i in range(vehicles):
        speeds[k, i] = speed_after[i]
        if i > 0:
            gaps[k, i - 1] += way[i - 1] - way[i]
    return True


@compiled
def move_by_events(line: Line, duration: float, start_s: float, world: int, tally: Tally, recorded: int,
                   scratch: Scratch) -> tuple[int, int]:  # fmt: skip
    """Move a world through its segment event by event. Returns how many impacts are recorded by now, and a status."""
    now = 0.0
    for i in range(line.speed.shape[0]):
        scratch.active[i] = line.onset[i] <= 0.0
    scratch.contact_speed[:] = 0.0
    for _ in range(MOST_EVENTS):
        if resolve_impacts(line.gap, line.speed, scratch.contact_speed, line.mass, line.restitution, scratch.cluster):
            recorded = record(line, scratch.cluster, tally, world, start_s + now, recorded)
            scratch.contact_speed[:] = 0.0
            continue
        if now >= duration:
            return recorded, DONE
        accelerate(line, scratch)
        passed = next_event(line, now, duration, scratch)
        if not move(line, passed, scratch):
            return recorded, PENETRATED
        for i in range(line.speed.shape[0]):
            scratch.active[i] = scratch.active[i] or line.onset[i] - now <= passed
        now = duration if passed >= duration - now else now + passed
    return recorded, STUCK


@compiled
def record(line: Line, cluster: Cluster, tally: Tally, world: int, time_s: float, recorded: int) -> int:
    """Write one round of impacts to the tally; rows beyond the table's capacity are only counted."""
    for p in range(line.gap.shape[0]):
        if cluster.struck[p] == 0:
            continue
        harm = cluster.closing[p] * cluster.closing[p]
        if recorded < tally.rows.shape[0]:
            row = tally.rows[recorded]
            row[0] = world
            row[1] = p
            row[2] = time_s
            row[3] = cluster.closing[p]
            row[4] = 0.0 if tally.hit[p] else 1.0
            row[5] = line.speed[p] - cluster.before[p]
            row[6] = line.speed[p + 1] - cluster.before[p + 1]
        recorded += 1
        tally.total_harm[p] += harm
        tally.count[p] += 1
        if not tally.hit[p]:
            tally.hit[p] = True
            tally.first_harm[p] += harm
    return recorded


@compiled
def accelerate(line: Line, scratch: Scratch) -> None:
    """Accelerations in force, touching vehicles coupled; marks the pairs that move as one body."""
    vehicles = line.speed.shape[0]
    force, joined, out = scratch.force, scratch.joined, scratch.acceleration
    for i in range(vehicles):
        wanted = line.command[i] if scratch.active[i] else 0.0
        force[0, i], force[1, i] = force_range(line.speed[i], wanted, line.limit[i])
    first = 0
    while first < vehicles:
        last = first
        while last < vehicles - 1 and line.gap[last] <= 0.0 and line.speed[last] == line.speed[last + 1]:
            last += 1
        if last == first:
            out[first] = settle(force[0, first], force[1, first])
        else:
            pool(force[0], force[1], line.mass, first, last, out, scratch.cluster.block)
            for p in range(first, last):
                joined[p] = out[p] == out[p + 1]
        if last < vehicles - 1:
            joined[last] = False
        first = last + 1


@compiled
def next_event(line: Line, now: float, end: float, scratch: Scratch) -> float:
    """Time from ``now`` to the next event, at most ``end - now``; fills the candidates of each vehicle and pair."""
    vehicles = line.speed.shape[0]
    soonest = end - now
    for i in range(vehicles):
        wanted = line.command[i] if scratch.active[i] else 0.0
        time, value = speed_event(line.speed[i], scratch.acceleration[i], wanted, line.limit[i])
        scratch.speed_time[i] = time
        scratch.speed_value[i] = value
        soonest = min(soonest, time)
        if not scratch.active[i]:
            soonest = min(soonest, line.onset[i] - now)
    for p in range(vehicles - 1):
        scratch.contact_time[p] = math.inf
        scratch.contact_speed[p] = 0.0
        if not scratch.joined[p]:
            closing = line.speed[p + 1] - line.speed[p]
            pressing = scratch.acceleration[p + 1] - scratch.acceleration[p]
            time, speed = contact(line.gap[p], closing, pressing)
            scratch.contact_time[p] = time
            scratch.contact_speed[p] = speed
            soonest = min(soonest, time)
    return soonest


@compiled
def move(line: Line, duration: float, scratch: Scratch) -> bool:
    """Move to the next event, putting event values exactly; False when a gap became impossible."""
    sound = True
    for p in range(line.gap.shape[0]):
        if scratch.contact_time[p] <= duration:
            line.gap[p] = 0.0
            continue
        scratch.contact_speed[p] = 0.0
        if not scratch.joined[p]:
            closing = line.speed[p + 1] - line.speed[p]
            pressing = scratch.acceleration[p + 1] - scratch.acceleration[p]
            after = drift(line.gap[p], closing, pressing, duration)
            sound = sound and after >= -PENETRATION_TOLERANCE_M
            line.gap[p] = max(after, 0.0)
    move_speeds(line, duration, scratch)
    return sound


@compiled
def move_speeds(line: Line, duration: float, scratch: Scratch) -> None:
    """Speeds after ``duration``: one value for each joined body, and a pair in contact differs by its closing speed."""
    pairs = line.gap.shape[0]
    first = 0
    while first <= pairs:
        value = line.speed[first] + scratch.acceleration[first] * duration
        last = first
        if scratch.speed_time[first] <= duration:
            value = scratch.speed_value[first]
        while last < pairs and scratch.joined[last]:
            last += 1
            if scratch.speed_time[last] <= duration:
                value = scratch.speed_value[last]
        if first > 0 and scratch.contact_speed[first - 1] > 0.0:
            value = line.speed[first - 1] + scratch.contact_speed[first - 1]
        for i in range(first, last + 1):
            line.speed[i] = value
        first = last + 1
