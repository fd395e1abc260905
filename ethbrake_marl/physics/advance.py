"""Exact, event-driven advance of many worlds under commands held constant.

Between events (command onset, standstill, speed limit, contact, end of segment) accelerations are constant and the
motion is closed form; impacts and resting contact follow ``impact``. Half-open rule: an event exactly at the end
of a segment belongs to that segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.events import contact, drift, force_range, no_contact_within, settle, speed_event
from ethbrake_marl.physics.impact import pool, resolve_impacts
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds

PENETRATION_TOLERANCE_M = 1e-9  # a gap below minus this means that a contact was missed
_MOST_EVENTS = 100_000  # per world and segment; reached only by a defect of the kernel
_DONE, _PENETRATED, _STUCK = 0, 1, 2


@dataclass(frozen=True, slots=True)
class ImpactRows:
    """Every impact of a segment, by world and then by time; arrays [k]."""

    world: Ints
    pair: Ints
    time_s: Floats  # since Vehicle 1 began to brake
    closing_speed_mps: Floats  # immediately before, > 0
    first: Bools  # the pair had no impact before
    front_speed_change_mps: Floats  # of the pair's front vehicle in this cluster of impacts, >= 0
    rear_speed_change_mps: Floats  # of its rear vehicle, usually negative


@dataclass(frozen=True, slots=True)
class Impacts:
    """What happened in a segment. Harm of a pair's impact is its squared closing speed (m2/s2)."""

    first_impact_harm: Floats  # [n, P] only impacts of pairs that had none before
    total_harm: Floats  # [n, P] every impact
    count: Ints  # [n, P]
    rows: ImpactRows | None = None  # only when recorded


@compiled
def accelerate(
    gap: Floats, speed: Floats, command: Floats, active: Bools, limit: Floats, mass: Floats,
    force: Floats, block: Floats, joined: Bools, out: Floats,
) -> None:  # fmt: skip
    """Accelerations of one world, touching vehicles coupled; ``joined[p]``: pair p moves as one body."""
    vehicles = speed.shape[0]
    for i in range(vehicles):
        wanted = command[i] if active[i] else 0.0
        force[0, i], force[1, i] = force_range(speed[i], wanted, limit[i])
    first = 0
    while first < vehicles:
        last = first
        while last < vehicles - 1 and gap[last] <= 0.0 and speed[last] == speed[last + 1]:
            last += 1
        if last == first:
            out[first] = settle(force[0, first], force[1, first])
        else:
            pool(force[0], force[1], mass, first, last, out, block)
            for p in range(first, last):
                joined[p] = out[p] == out[p + 1]
        if last < vehicles - 1:
            joined[last] = False
        first = last + 1


@compiled
def next_event(
    gap: Floats, speed: Floats, acceleration: Floats, command: Floats, active: Bools, limit: Floats, onset: Floats,
    joined: Bools, now: float, end: float, speed_time: Floats, speed_value: Floats, contact_time: Floats,
    contact_speed: Floats,
) -> float:  # fmt: skip
    """Time from ``now`` to the next event, at most ``end - now``; fills the candidates of each vehicle and pair."""
    vehicles = speed.shape[0]
    soonest = end - now
    for i in range(vehicles):
        wanted = command[i] if active[i] else 0.0
        speed_time[i], speed_value[i] = speed_event(speed[i], acceleration[i], wanted, limit[i])
        soonest = min(soonest, speed_time[i])
        if not active[i]:
            soonest = min(soonest, onset[i] - now)
    for p in range(vehicles - 1):
        contact_time[p] = math.inf
        contact_speed[p] = 0.0
        if not joined[p]:
            closing = speed[p + 1] - speed[p]
            pressing = acceleration[p + 1] - acceleration[p]
            contact_time[p], contact_speed[p] = contact(gap[p], closing, pressing)
            soonest = min(soonest, contact_time[p])
    return soonest


@compiled
def move(
    gap: Floats, speed: Floats, acceleration: Floats, joined: Bools, duration: float, speed_time: Floats,
    speed_value: Floats, contact_time: Floats, contact_speed: Floats,
) -> int:  # fmt: skip
    """Move one world to its next event, in place, putting event values exactly; zeroes contacts that are not due."""
    pairs = gap.shape[0]
    status = _DONE
    for p in range(pairs):
        closing = speed[p + 1] - speed[p]
        pressing = acceleration[p + 1] - acceleration[p]
        if contact_time[p] <= duration:
            gap[p] = 0.0
        else:
            contact_speed[p] = 0.0
            if not joined[p]:
                after = drift(gap[p], closing, pressing, duration)
                if after < -PENETRATION_TOLERANCE_M:
                    status = _PENETRATED
                gap[p] = max(after, 0.0)
    first = 0
    while first <= pairs:
        value = speed[first] + acceleration[first] * duration
        last = first
        if speed_time[first] <= duration:
            value = speed_value[first]
        while last < pairs and joined[last]:
            last += 1
            if speed_time[last] <= duration:
                value = speed_value[last]
        if first > 0 and contact_speed[first - 1] > 0.0:
            value = speed[first - 1] + contact_speed[first - 1]
        for i in range(first, last + 1):
            speed[i] = value
        first = last + 1
    return status


@compiled
def advance_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats, until: Floats, latency: Floats,
    mass: Floats, limit: Floats, restitution: Floats, first_harm: Floats, total_harm: Floats, count: Ints,
    rows: Floats,
) -> tuple[int, int, int]:  # fmt: skip
    """Advance every world to its ``until``, in place.

    ``rows`` [capacity, 7] receives the impacts that fit. Returns their whole number, the world where a check failed
    (or -1) and its status.
    """
    n, vehicles = speeds.shape
    pairs = vehicles - 1
    active = np.empty(vehicles, np.bool_)
    joined = np.empty(pairs, np.bool_)
    onset = np.empty(vehicles)
    force, work, block = np.empty((2, vehicles)), np.empty((2, vehicles)), np.empty((4, vehicles))
    acceleration, speed_time, speed_value, before = (
        np.empty(vehicles),
        np.empty(vehicles),
        np.empty(vehicles),
        np.empty(vehicles),
    )
    contact_time, contact_speed, closing = np.empty(pairs), np.zeros(pairs), np.empty(pairs)
    struck = np.empty(pairs, np.int64)
    recorded = 0
    for k in range(n):
        gap, speed = gaps[k], speeds[k]
        end = until[k] - time[k]
        now = 0.0
        quiet = True
        for i in range(vehicles):
            onset[i] = latency[k, i] - time[k]
            active[i] = onset[i] <= 0.0
            quiet = quiet and (active[i] or onset[i] > end)
            wanted = command[k, i] if active[i] else 0.0
            low, high = force_range(speed[i], wanted, limit[k, i])
            acceleration[i] = settle(low, high)
            quiet = quiet and speed_event(speed[i], acceleration[i], wanted, limit[k, i])[0] > end
        for p in range(pairs):
            quiet = quiet and no_contact_within(
                gap[p], speed[p + 1] - speed[p], acceleration[p + 1] - acceleration[p], end
            )
        if quiet:
            for p in range(pairs):
                gap[p] = drift(gap[p], speed[p + 1] - speed[p], acceleration[p + 1] - acceleration[p], end)
            for i in range(vehicles):
                speed[i] = speed[i] + acceleration[i] * end
            time[k] = until[k]
            continue
        status = _STUCK
        for p in range(pairs):
            contact_speed[p] = 0.0
        for _ in range(_MOST_EVENTS):
            if resolve_impacts(
                gap, speed, contact_speed, mass[k], restitution[k], closing, before, work, block, struck
            ):
                for p in range(pairs):
                    contact_speed[p] = 0.0
                    if struck[p]:
                        harm = closing[p] * closing[p]
                        if recorded < rows.shape[0]:
                            rows[recorded, 0] = k
                            rows[recorded, 1] = p
                            rows[recorded, 2] = time[k] + now
                            rows[recorded, 3] = closing[p]
                            rows[recorded, 4] = 0.0 if hit[k, p] else 1.0
                            rows[recorded, 5] = speed[p] - before[p]
                            rows[recorded, 6] = speed[p + 1] - before[p + 1]
                        recorded += 1
                        total_harm[k, p] += harm
                        count[k, p] += 1
                        if not hit[k, p]:
                            hit[k, p] = True
                            first_harm[k, p] += harm
                continue
            if now >= end:
                status = _DONE
                break
            accelerate(gap, speed, command[k], active, limit[k], mass[k], force, block, joined, acceleration)
            duration = next_event(
                gap, speed, acceleration, command[k], active, limit[k], onset, joined, now, end,
                speed_time, speed_value, contact_time, contact_speed,
            )  # fmt: skip
            status = move(
                gap, speed, acceleration, joined, duration, speed_time, speed_value, contact_time, contact_speed
            )
            if status != _DONE:
                break
            for i in range(vehicles):
                active[i] = active[i] or onset[i] - now <= duration
            now = end if duration >= end - now else now + duration
        if status != _DONE:
            return recorded, k, status
        time[k] = until[k]
    return recorded, -1, _DONE


def advance(
    worlds: Worlds,
    command_mps2: ArrayLike,
    duration_s: ArrayLike | None = None,
    *,
    until_s: ArrayLike | None = None,
    record: bool = False,
) -> tuple[Worlds, Impacts]:
    """Advance ``worlds`` exactly, each under its constant command, and report the impacts on the way.

    ``command_mps2`` [n, N] is the signed acceleration each vehicle wants; it is ignored before the vehicle's
    latency has elapsed, also when that falls inside the segment. Give either ``duration_s`` or the absolute end
    ``until_s`` (scalar or [n]). The result of a world does not depend on the batch it is in. Inputs are left alone.

    Raises ``InvalidInput`` for a command that is not finite or exceeds a vehicle's capacity, or an end before the
    worlds' time; ``PhysicsError`` if a check inside the kernel fails.
    """
    vehicles = worlds.vehicles
    command = _checked_command(worlds, command_mps2)
    until = _checked_end(worlds, duration_s, until_s)
    capacity = 4 * worlds.n + 64 if record else 0
    while True:
        gaps, speeds, time, hit = (a.copy() for a in (worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit))
        first_harm, total_harm = np.zeros_like(gaps), np.zeros_like(gaps)
        count = np.zeros(gaps.shape, np.int64)
        rows = np.empty((capacity, 7))
        recorded, world, status = advance_worlds(
            gaps, speeds, time, hit, command, until, vehicles.latency_s, vehicles.mass_t, vehicles.speed_limit_mps,
            vehicles.restitution, first_harm, total_harm, count, rows,
        )  # fmt: skip
        if status != _DONE:
            reason = "a contact was missed" if status == _PENETRATED else f"more than {_MOST_EVENTS} events"
            raise PhysicsError(f"world {world}: {reason} between {worlds.time_s[world]:g} s and {until[world]:g} s")
        if not record or recorded <= capacity:
            break
        capacity = recorded
    kept = _impact_rows(rows[:recorded]) if record else None
    in_force = np.where(vehicles.latency_s <= time[:, np.newaxis], command, 0.0)
    return Worlds(vehicles, gaps, speeds, time, hit, in_force), Impacts(first_harm, total_harm, count, kept)


def _checked_command(worlds: Worlds, command_mps2: ArrayLike) -> Floats:
    try:
        command = np.ascontiguousarray(np.broadcast_to(np.asarray(command_mps2, np.float64), worlds.speeds_mps.shape))
    except ValueError:
        raise InvalidInput(
            f"command_mps2: shape {np.shape(command_mps2)} does not fit [n, N] = {worlds.speeds_mps.shape}"
        ) from None
    vehicles = worlds.vehicles
    good = (command >= -vehicles.braking_capacity_mps2) & (command <= vehicles.driving_capacity_mps2)
    if not good.all():
        k, i = (int(a) for a in np.argwhere(~good)[0])
        low, high = -vehicles.braking_capacity_mps2[k, i], vehicles.driving_capacity_mps2[k, i]
        raise InvalidInput(f"command_mps2[{k}, {i}] = {command[k, i]:g}: must be in [{low:g}, {high:g}] m/s2")
    return command


def _checked_end(worlds: Worlds, duration_s: ArrayLike | None, until_s: ArrayLike | None) -> Floats:
    if (duration_s is None) == (until_s is None):
        raise InvalidInput("advance: give either duration_s or until_s")
    end = np.asarray(until_s if duration_s is None else worlds.time_s + np.asarray(duration_s), np.float64)
    if end.shape not in ((), (worlds.n,)):
        raise InvalidInput(f"advance: the end has shape {end.shape}; a number or [n] = ({worlds.n},) is needed")
    until = np.array(np.broadcast_to(end, (worlds.n,)))
    good = (until >= worlds.time_s) & np.isfinite(until)
    if not good.all():
        k = int(np.argmin(good))
        raise InvalidInput(f"advance: world {k} is at {worlds.time_s[k]:g} s and cannot be advanced to {until[k]:g} s")
    return until


def _impact_rows(rows: Floats) -> ImpactRows:
    return ImpactRows(
        rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2].copy(), rows[:, 3].copy(),
        rows[:, 4] > 0.0, rows[:, 5].copy(), rows[:, 6].copy(),
    )  # fmt: skip
