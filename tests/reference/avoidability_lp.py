"""Avoidability as a linear programme: approximate, but for any line and any set of controlled vehicles.

Time is cut into steps of ``h``. Each controlled vehicle has a constant acceleration in each step, so its speeds and
positions at the ends of steps are linear in the unknowns; gaps are watched at the ends of steps only. The programme
finds the largest smallest gap ``m``:

    v[k+1] = v[k] + d[k]        x[k+1] = x[k] + h v[k] + o[k] d[k] / 2        -a o[k] <= d[k] <= a_u o[k]
    0 <= v[k] <= limit          x_i[k] - x_i+1[k] >= m    for every pair (i, i+1) that holds a controlled vehicle

``o[k]`` is the part of the step after the vehicle's latency. All other vehicles brake fully from theirs. A controlled
vehicle with another one in front must stand at the horizon. docs/avoidability.md derives the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.kernel import solo_motion


class LinearVerdict(NamedTuple):
    """What the linear programme says about one world."""

    avoidable: bool  # the margin is not negative
    certain: bool  # the margin is further from 0 than the tolerance
    margin_m: float  # the largest smallest gap, at the ends of steps
    tolerance_m: float  # error of the margin that the discretisation explains
    time_s: Floats  # [K] starts of the steps
    command_mps2: Floats  # [K, C] of the controlled vehicles, by index


def avoidable_by_lp(
    world: Worlds, controlled: Sequence[int], step_s: float, *, horizon_s: float | None = None
) -> LinearVerdict:
    """Whether ``controlled`` vehicles (indices from 0) of one world can together avoid all contact, approximately.

    The margin is off by at most ``step_s^2 max(a + a_u)`` as long as the best profile changes its command no more than
    six times; a verdict within that tolerance is not ``certain``. ``horizon_s`` counts from the world's time; the
    default is the last standstill or latency of all, plus ``limit / a`` of each controlled vehicle. The step and the
    latencies of the controlled vehicles must lie below it; the world moves forward, and has no obstacle.
    """
    cars = tuple(sorted(controlled))
    onset = _onset_s(world)
    horizon = default_horizon_s(world, cars) if horizon_s is None else horizon_s
    assert 0.0 < step_s < horizon < math.inf and np.all(onset[list(cars)] < horizon)
    steps = math.ceil(horizon / step_s - 1e-9)
    programme = _Programme(world, cars, onset, step_s * np.arange(steps + 1, dtype=np.float64))
    return programme.solve()


def default_horizon_s(world: Worlds, controlled: Sequence[int]) -> float:
    """Time from now by which all is decided: every standstill and latency, and ``limit / a`` of each controlled. [s]"""
    v = world.vehicles
    onset = _onset_s(world)
    stand = float(np.max(onset + world.speeds_mps[0] / v.braking_capacity_mps2[0]))
    top = np.maximum(v.speed_limit_mps[0], world.speeds_mps[0]) / v.braking_capacity_mps2[0]
    return stand + float(top[list(controlled)].sum())


def _onset_s(world: Worlds) -> Floats:
    """Time from now at which each vehicle may act, [N]."""
    return np.maximum(world.vehicles.latency_s[0] - world.time_s[0], 0.0)


class _Programme:
    """The rows and columns of one world. Car c has K + 1 positions, K + 1 speeds, K changes of speed; last comes m."""

    def __init__(self, world: Worlds, cars: tuple[int, ...], onset: Floats, time: Floats) -> None:
        self._world = world
        self._cars = cars
        self._onset = onset
        self._time = time  # [K + 1] from now
        self._step = float(time[1])
        self._K = time.size - 1
        self._columns = len(cars) * (3 * self._K + 2) + 1
        self._start = np.concatenate([[0.0], -np.cumsum(world.gaps_m[0])])
        self._active = {i: np.clip(time[1:] - onset[i], 0.0, self._step) for i in cars}  # o

    def solve(self) -> LinearVerdict:
        """Maximise the smallest gap."""
        world, K = self._world, self._K
        rows, right, fixed = self._gaps()
        objective = np.zeros(self._columns)
        objective[-1] = -1.0
        found: Any = linprog(
            objective, A_ub=rows, b_ub=right, A_eq=self._motion(), b_eq=np.zeros(2 * K * len(self._cars)),
            bounds=self._bounds(), method="highs",
        )  # fmt: skip
        assert found.status == 0, f"{found.message} (is horizon_s long enough to come to rest?)"
        margin = min(-float(found.fun), fixed) if fixed < 0.0 else -float(found.fun)
        v = world.vehicles
        tolerance = self._step * self._step * float((v.braking_capacity_mps2 + v.driving_capacity_mps2).max())
        command = np.zeros((K, len(self._cars)))
        for c, i in enumerate(self._cars):
            change = found.x[self._speed(c, K) + 1 :][:K]
            command[:, c] = np.divide(change, self._active[i], out=np.zeros(K), where=self._active[i] > 0.0)
            command[:, c] = np.clip(command[:, c], -v.braking_capacity_mps2[0, i], v.driving_capacity_mps2[0, i])
        return LinearVerdict(
            margin >= 0.0, abs(margin) > tolerance, margin, tolerance, world.time_s[0] + self._time[:-1], command
        )

    def _position(self, c: int, k: int) -> int:
        return c * (3 * self._K + 2) + k

    def _speed(self, c: int, k: int) -> int:
        return self._position(c, self._K + 1 + k)

    def _motion(self) -> Any:
        """Rows of the equations of motion, all equal to 0."""
        K = self._K
        now, then, one = sparse.eye_array(K, K + 1), sparse.eye_array(K, K + 1, k=1), sparse.eye_array(K)
        blocks = [
            sparse.block_array(
                [[then - now, -self._step * now, sparse.diags_array(-0.5 * self._active[i])], [None, then - now, -one]]
            )
            for i in self._cars
        ]
        return sparse.csr_array(sparse.hstack([sparse.block_diag(blocks), sparse.csr_array((2 * K * len(blocks), 1))]))

    def _bounds(self) -> Floats:
        """Bounds of every unknown, [columns, 2]."""
        world, K = self._world, self._K
        bounds = np.tile([-np.inf, np.inf], (self._columns, 1))
        for c, i in enumerate(self._cars):
            speed = world.speeds_mps[0, i]
            bounds[self._position(c, 0)] = self._start[i]
            first, last = self._speed(c, 0), self._speed(c, K)
            bounds[first : last + 1] = 0.0, max(world.vehicles.speed_limit_mps[0, i], speed)
            bounds[first] = speed
            if i > 0:
                bounds[last] = 0.0
            change = slice(last + 1, last + 1 + K)
            bounds[change, 0] = -world.vehicles.braking_capacity_mps2[0, i] * self._active[i]
            bounds[change, 1] = world.vehicles.driving_capacity_mps2[0, i] * self._active[i]
        return bounds

    def _gaps(self) -> tuple[Any, Floats, float]:
        """Rows ``m - gap <= right`` of the gaps that can be changed, and the smallest of those that cannot."""
        fixed, rows, right = math.inf, [], []
        for p in range(self._world.N - 1):
            acting = [self._onset[i] for i in (p, p + 1) if i in self._cars]
            free = np.flatnonzero(self._time > min(acting, default=math.inf))
            undecided = self._scripted(p) - self._scripted(p + 1)
            if free.size < self._time.size:
                before = np.delete(self._coasting(p) - self._coasting(p + 1), free)
                fixed = min(fixed, float(before.min()))
            rows.append(self._gap_rows(p, free))
            right.append(undecided[free])
        return sparse.vstack(rows, format="csr"), np.concatenate(right), fixed

    def _gap_rows(self, p: int, free: Ints) -> Any:
        """``m - x_p + x_p+1`` at the times ``free``, controlled vehicles only."""
        row = np.arange(free.size)
        entries = [(row, np.full(free.size, self._columns - 1), 1.0)]
        for i, sign in ((p, -1.0), (p + 1, 1.0)):
            if i in self._cars:
                entries.append((row, self._position(self._cars.index(i), 0) + free, sign))
        values = np.concatenate([np.full(free.size, sign) for _, _, sign in entries])
        where = (np.concatenate([r for r, _, _ in entries]), np.concatenate([column for _, column, _ in entries]))
        return sparse.csr_array((values, where), shape=(free.size, self._columns))

    def _scripted(self, i: int) -> Floats:
        """Positions [K + 1] of a vehicle that brakes fully; 0 for a controlled one, whose positions are unknowns."""
        return np.zeros(self._time.size) if i in self._cars else self._coasting(i)

    def _coasting(self, i: int) -> Floats:
        """Positions [K + 1] of a vehicle whose command is full braking; right for any until its latency has elapsed."""
        braking = -float(self._world.vehicles.braking_capacity_mps2[0, i])
        speed, onset = float(self._world.speeds_mps[0, i]), float(self._onset[i])
        ways = [solo_motion(speed, braking, onset, math.inf, float(t))[1] if t > 0.0 else 0.0 for t in self._time]
        return np.asarray(self._start[i] + np.array(ways))
