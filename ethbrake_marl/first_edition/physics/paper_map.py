"""The paper's fixed-step map (eq. dynamics2), in which impacts are detected and take effect only at sample times.

With the sampling period h, one step of a vehicle with command u, from sample n to sample n + 1, is

    x(n + 1) = x(n) + h f(n) + h^2 / 2 u(n)
    v(n + 1) = f(n) + h u(n)

where f(n) is the vehicle's speed after the impacts of sample n. If at a sample the gap of a pair is at most 0 and its
closing speed is above 0, the speeds of the pair change by the paper's eq. (13). In the paper, f3 is the impact of
Vehicles 2 and 3, and f1 the impact of Vehicles 1 and 2. For Vehicle 2, f is f1 applied after f3: first comes the impact
with Vehicle 3, then the impact with Vehicle 1, which uses the speed that Vehicle 2 has after the first impact.

The paper leaves some points open. This map resolves these points as follows:

* The impact f1 starts from the speeds that result from the impact f3. The closing speed of the front impact, and its
  harm, therefore depend on the impact f3. The paper's formula of J_harm uses the speeds before both impacts. The
  paper's formula and this map lead to different harms only if both pairs have an impact at the same sample.
* The paper's formulas of f1 and f3 also change the speeds of overlapping vehicles that are separating, and would pull
  these vehicles together again. The paper's text below eq. (13) requires a positive relative velocity (closing speed).
  This map therefore changes speeds and counts harm only if the relative velocity is positive.
* Samples are at ``tau_2 + n h``, where tau_2 is the latency of Vehicle 2. Before its first sample a world moves
  exactly, and no impact is detected, because the paper assumes that no impact happens before this sample.
* The command of a step is the command in force at the sample that begins the step (zero-order hold). If the latency of
  a vehicle ends between two samples, its command takes effect at the later of these two samples.
* In the paper ``0 <= v <= v_max`` is a constraint on u and not part of the map. This map limits the command of every
  vehicle so that the vehicle's speed satisfies the constraint at the next sample. An impact can leave a negative speed.
  Setting it to 0 would violate conservation of momentum. The map therefore keeps the negative speed, and the brakes
  bring it back to 0.

The paper defines the map for N = 3. For any N, this map resolves each pair once per sample, from the rear pair to the
front pair. A gap is negative while the vehicles of the pair overlap; nothing pushes the vehicles apart. Source: the
paper, section "Optimization Problem".

The kernels take fields of ``Worlds`` and ``Vehicles`` under short names, for example ``gaps`` for ``gaps_m``; ``k`` is
the index of a world in all arrays. ``command`` [n, N] are the commands, m/s2, not the accelerations in force.
``first_harm`` and ``total_harm`` (m2/s2) are the two counts of harm, and ``count`` is the number of impacts, of each
pair, [n, P]; the kernels add to them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.advance import refuse_bad, shaped
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.motion import BOUND, has_acted, solo_motion
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

SHORTEST_STEP_S = 1e-6

MOST_STEPS = 10**9  # largest number of steps in one call

_ON_SAMPLE = 1e-6  # part of a step: times this close count as one sample, because times are rounded


@compiled
def exchange(
    front_mps: float, rear_mps: float, front_t: float, rear_t: float, restitution: float
) -> tuple[float, float]:
    """Return the speeds (m/s) of the front and the rear vehicle of a pair after its impact, by the paper's eq. (13).

    With the closing speed w = v_{i+1} - v_i: ``v_i+ = v_i + m_{i+1} (1 + e) w / (m_i + m_{i+1})`` and
    ``v_{i+1}+ = v_{i+1} - m_i (1 + e) w / (m_i + m_{i+1})``.

    Args:
        front_mps: speed v_i of the front vehicle, m/s.
        rear_mps: speed v_{i+1} of the rear vehicle, m/s.
        front_t: mass m_i of the front vehicle, t.
        rear_t: mass m_{i+1} of the rear vehicle, t.
        restitution: coefficient of restitution e, in [0, 1].

    """
    impulse = (1.0 + restitution) * (rear_mps - front_mps) / (front_t + rear_t)
    return front_mps + rear_t * impulse, rear_mps - front_t * impulse


@compiled
def exchange_at_sample(
    k: int, gaps: Floats, speeds: Floats, mass: Floats, restitution: float, hit: Bools, first_harm: Floats,
    total_harm: Floats, count: Ints,
) -> None:  # fmt: skip
    """Apply the impacts of world ``k`` at a sample, from the rear pair to the front pair, and add their harm.

    As in ``advance``, contact with a closing speed of at most ``TOUCH_SPEED_MPS`` is a touch, which does no harm.
    ``speeds`` and ``hit`` are updated.
    """
    for p in range(gaps.shape[1] - 1, -1, -1):
        closing = speeds[k, p + 1] - speeds[k, p]
        if gaps[k, p] > 0.0 or closing <= 0.0:
            continue
        front, rear = exchange(speeds[k, p], speeds[k, p + 1], mass[k, p], mass[k, p + 1], restitution)
        speeds[k, p] = front
        speeds[k, p + 1] = rear
        if closing <= BOUND.TOUCH_SPEED_MPS:
            continue
        harm = closing * closing
        total_harm[k, p] += harm
        count[k, p] += 1
        if not hit[k, p]:
            hit[k, p] = True
            first_harm[k, p] += harm


@compiled
def held_motion(speed: float, command: float, limit: float, step: float) -> tuple[float, float]:
    """Return speed (m/s) and distance (m) after a step of constant command: ``v + h u`` and ``h v + h^2 u / 2``.

    The command u is first limited so that the speed does not go beyond 0 or the speed limit within the step. The
    distance is computed as h times the mean of the speeds at the start and the end of the step, which for constant u is
    equal to ``h v + h^2 u / 2``. Brakes act against the motion, so they also bring a negative speed back to 0.

    Args:
        speed: speed v at the start, m/s; may be negative after an impact.
        command: command u, m/s2; negative brakes.
        limit: speed up to which the vehicle drives, m/s.
        step: length h of the step, s.

    """
    after = speed
    if command < 0.0:
        after = max(speed + command * step, 0.0) if speed >= 0.0 else min(speed - command * step, 0.0)
    elif command > 0.0 and speed < limit:
        after = min(speed + command * step, limit)
    return after, 0.5 * (speed + after) * step


@compiled
def move_to_grid(
    k: int, duration: float, time: float, gaps: Floats, speeds: Floats, command: Floats, latency: Floats, limit: Floats
) -> None:
    """Move world ``k`` exactly and without impacts for ``duration`` (s) from ``time`` (s), before its first sample.

    ``gaps`` and ``speeds`` are updated.
    """
    way_in_front = 0.0
    for i in range(speeds.shape[1]):
        after, way, _ = solo_motion(speeds[k, i], command[k, i], latency[k, i] - time, limit[k, i], duration)
        speeds[k, i] = after
        if i > 0:
            gaps[k, i - 1] += way_in_front - way
        way_in_front = way


@compiled
def sample_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, command: Floats, until: Floats, step: float, first: Ints,
    last: Ints, latency: Floats, mass: Floats, limit: Floats, restitution: Floats, first_harm: Floats,
    total_harm: Floats, count: Ints,
) -> None:  # fmt: skip
    """Advance every world in place by the paper's fixed-step map, from sample ``first`` to sample ``last``.

    Sample 0 is at the time at which the latency of Vehicle 2 has elapsed. The function updates ``gaps``, ``speeds``,
    ``time`` and ``hit``.

    - ``until``: end times, [n] s; used only for a world whose end time is before sample 0.
    - ``step``: sampling period, s.
    - ``first``: number of the sample at which each world starts, [n]; -1 if it starts before sample 0.
    - ``last``: number of the sample at which each world ends, [n]; -1 if it ends before sample 0.
    """
    for k in range(speeds.shape[0]):
        start = latency[k, 1]
        begin = first[k]
        if begin < 0:
            end = until[k] if last[k] < 0 else start
            move_to_grid(k, end - time[k], time[k], gaps, speeds, command, latency, limit)
            time[k] = end
            begin = 0
        for n in range(begin, last[k]):
            exchange_at_sample(k, gaps, speeds, mass, restitution[k], hit, first_harm, total_harm, count)
            now = start + n * step + _ON_SAMPLE * step
            way_in_front = 0.0
            for i in range(speeds.shape[1]):
                wanted = command[k, i] if latency[k, i] <= now else 0.0
                speeds[k, i], way = held_motion(speeds[k, i], wanted, limit[k, i], step)
                if i > 0:
                    gaps[k, i - 1] += way_in_front - way
                way_in_front = way
        if last[k] > begin:
            time[k] = start + last[k] * step


def advance_sampled(
    worlds: Worlds, command_mps2: ArrayLike, *, until_s: ArrayLike, step_s: float = 0.1
) -> tuple[Worlds, Impacts]:
    """Advance ``worlds`` by the paper's fixed-step map under constant commands; return new worlds and impacts.

    The first sample is at the time at which the latency of Vehicle 2 has elapsed; samples are ``step_s`` apart. A world
    ends at the first of its samples at or after ``until_s``, or at ``until_s`` itself if ``until_s`` is before the
    first sample. The returned state is the paper's s(n), the state before the impacts of the last sample. The next call
    applies these impacts, so the result can be passed to this function again. ``Impacts.rows`` is None. The result of a
    world does not depend on the other worlds.

    Gaps of the result may be negative. Advance worlds with negative gaps with this function and not with ``advance``.

    Args:
        worlds: n worlds of N vehicles; they are not changed.
        command_mps2: commanded accelerations, [n, N] m/s2; a command has no effect before the vehicle's latency has
            elapsed.
        until_s: end time since the alert, one number or [n], s.
        step_s: sampling period h, s.

    Raises ``InvalidInput`` for a command beyond a vehicle's capacity, an ``until_s`` before the present time of a
    world, a ``step_s`` below 1e-6 s, a world whose present time is between two samples, negative speeds before the
    first sample, brakes that build up, a vehicle that follows a fixed sequence of commands, or an obstacle ahead.

    """
    if worlds.obstacle_ahead.any():
        k = int(np.argmax(worlds.obstacle_ahead))
        raise InvalidInput(
            f"advance_sampled: world {k} has an obstacle ahead (obstacle_gap_m = {worlds.obstacle_gap_m[k]:g}); the"
            " paper's fixed-step physics has no obstacle; use advance"
        )
    worlds.refuse_build_up("advance_sampled")
    command = shaped("command_mps2", command_mps2, worlds.speeds_mps.shape)
    until = shaped("until_s", until_s, (worlds.n,))
    refuse_bad(worlds, command, until, np.ones(worlds.n, np.bool_))
    _refuse_unsampled(worlds, until, step_s)
    after = worlds.copy()
    impacts = sample_on(after, command, until, step_s)
    after.command_mps2[...] = np.where(has_acted(worlds.vehicles.latency_s, after.time_s[:, np.newaxis]), command, 0.0)
    return after, impacts


def sample_on(worlds: Worlds, command: Floats, until: Floats, step_s: float) -> Impacts:
    """Advance ``worlds`` in place as ``advance_sampled`` does, without checks, and return the impacts.

    The function does not update ``command_mps2`` of the worlds. ``command`` is [n, N] m/s2; ``until`` are end times
    since the alert, [n] s.
    """
    vehicles = worlds.vehicles
    start = vehicles.latency_s[:, 1]
    position, end = (worlds.time_s - start) / step_s, (until - start) / step_s  # times of samples may be rounded
    first = np.where(position < -_ON_SAMPLE, -1.0, np.rint(position)).astype(np.int64)
    last = np.where(end < -_ON_SAMPLE, -1.0, np.ceil(end - _ON_SAMPLE)).astype(np.int64)
    gaps, time = worlds.gaps_m, worlds.time_s
    first_harm, total_harm, count = np.zeros(gaps.shape), np.zeros(gaps.shape), np.zeros(gaps.shape, np.int64)
    sample_worlds(
        gaps, worlds.speeds_mps, time, worlds.pair_hit, command, until, float(step_s), first, last, vehicles.latency_s,
        vehicles.mass_t, vehicles.speed_limit_mps, vehicles.restitution, first_harm, total_harm, count,
    )  # fmt: skip
    return Impacts(first_harm, total_harm, count, *Impacts.no_obstacle(worlds.n))


def _refuse_unsampled(worlds: Worlds, until: Floats, step_s: float) -> None:
    """Raise ``InvalidInput`` for a sampling period, an end time or a state that the fixed-step map does not allow."""
    if not (SHORTEST_STEP_S <= step_s < math.inf):
        raise InvalidInput(f"step_s = {step_s:g}: must be finite and at least {SHORTEST_STEP_S:g} s")
    good = (until >= worlds.time_s) & (until <= worlds.time_s + MOST_STEPS * step_s)
    if not good.all():
        k = int(np.argmin(good))
        raise InvalidInput(
            f"advance_sampled: world {k} cannot be advanced from {worlds.time_s[k]:g} s to {until[k]:g} s; the"
            f" end must not be earlier than the start, and at most {MOST_STEPS:,} steps of {step_s:g} s later"
        )
    start = worlds.vehicles.latency_s[:, 1]
    position = (worlds.time_s - start) / step_s
    before = position < -_ON_SAMPLE
    good = before | (np.abs(position - np.rint(position)) <= _ON_SAMPLE)
    if not good.all():
        k = int(np.argmin(good))
        raise InvalidInput(
            f"advance_sampled: world {k} is at {worlds.time_s[k]:g} s, between two of its sampling times, which are"
            f" {start[k]:g} s + n * {step_s:g} s for n = 0, 1, ...; start at a sampling time, or before the first"
        )
    good = ~before[:, np.newaxis] | (worlds.speeds_mps >= 0.0)
    if not good.all():
        k = int(np.argmin(good.all(axis=1)))
        raise InvalidInput(
            f"advance_sampled: world {k} has a negative speed at {worlds.time_s[k]:g} s, before its first sample at"
            f" {start[k]:g} s; speeds must be at least 0 there, because the paper's fixed-step physics has no impacts"
            " before the first sample"
        )
