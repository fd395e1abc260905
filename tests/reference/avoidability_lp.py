"""Avoidability as a linear programme: approximate, but for any line and any set of controlled vehicles.

Time is cut into steps of ``h``. Each controlled vehicle has a constant acceleration in each step, so its speeds and
positions at the ends of steps are linear in the unknowns; gaps are watched at the ends of steps only. The programme
finds the largest smallest gap ``m``:

    v[k+1] = v[k] + d[k]        x[k+1] = x[k] + h v[k] + o[k] d[k] / 2        -a o[k] <= d[k] <= a_u o[k]
    0 <= v[k] <= limit          x_i[k] - x_i+1[k] >= m    for every pair (i, i+1) that holds a controlled vehicle

``o[k]`` is the part of the step after the vehicle's latency. All other vehicles brake fully from theirs. A controlled
vehicle with another one in front must stand at the horizon.

The tolerance is ``h^2 max(a + a_u)``. Each change of the command within a step moves a position by at most
``(a + a_u) h^2 / 8``, so with at most six changes m is at least the true margin minus 3/4 of the tolerance. Within a
step a gap can be smaller than at its ends by at most a quarter of the tolerance. One controlled vehicle needs four
changes. For several the number is not known, so the programme is only an approximation there.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import LIMIT, Floats


class LinearVerdict(NamedTuple):
    """What the linear programme says about one world."""

    avoidable: bool  # the margin is not negative
    certain: bool  # the margin is further from 0 than the discretisation explains
    margin_m: float  # the largest smallest gap, at the ends of steps


def avoidable_by_lp(world: State, controlled: Sequence[int], K: int) -> LinearVerdict:
    """Whether ``controlled`` vehicles (indices from 0) of one world can together avoid all contact, by ``K`` steps.

    The margin is off by at most ``h^2 max(a + a_u)`` as long as the best profile changes its command no more than six
    times; a verdict within that tolerance is not ``certain``. The horizon is the last standstill or latency of all,
    plus ``limit / a`` of each controlled vehicle. The world moves forward, and has no obstacle.
    """
    cars, speeds = sorted(controlled), world.speeds_mps[0]
    braking, driving = world.braking_capacity_mps2[0], world.driving_capacity_mps2[0]
    limit = np.maximum(world.car[0, LIMIT, 1:], speeds)
    onset = np.maximum(world.latency_s[0] - world.time_s[0], 0.0)  # from now
    horizon = np.max(onset + speeds / braking) + np.sum(limit[cars] / braking[cars])
    step = horizon / K
    time = step * np.arange(K + 1)
    start = -np.concatenate([[0.0], np.cumsum(world.gaps_m[0])])
    alone = [start[i] + ways(speeds[i], braking[i], onset[i], time) for i in range(world.vehicles)]

    # The unknowns of a car are K + 1 positions, K + 1 speeds and K changes of speed; last of all comes m.
    columns = len(cars) * (3 * K + 2) + 1
    now, then, one = sparse.eye_array(K, K + 1), sparse.eye_array(K, K + 1, k=1), sparse.eye_array(K)
    motion, bounds = [], []
    for i in cars:
        active = np.clip(time[1:] - onset[i], 0.0, step)  # o
        position = [then - now, -step * now, sparse.diags_array(-0.5 * active)]
        motion.append(sparse.block_array([position, [None, then - now, -one]]))
        bounds += [(start[i], start[i])] + [(None, None)] * K
        bounds += [(speeds[i], speeds[i])] + [(0.0, limit[i])] * (K - 1) + [(0.0, 0.0 if i > 0 else limit[i])]
        bounds += zip(-braking[i] * active, driving[i] * active, strict=True)
    nothing = sparse.csr_array((K + 1, columns))
    m = sparse.kron(np.ones((K + 1, 1)), sparse.eye_array(1, columns, k=columns - 1), format="csr")
    places = {i: sparse.eye_array(K + 1, columns, k=c * (3 * K + 2)).tocsr() for c, i in enumerate(cars)}
    rows, right, fixed = [], [], math.inf  # of gaps that can be changed: m - gap <= right; and of those that cannot
    for p in range(world.vehicles - 1):
        free = time > min((onset[i] for i in (p, p + 1) if i in cars), default=math.inf)
        fixed = min(fixed, np.min((alone[p] - alone[p + 1])[~free], initial=math.inf))
        gap = places.get(p, nothing) - places.get(p + 1, nothing)
        rows.append((m - gap)[free])
        right.append(((p not in cars) * alone[p] - (p + 1 not in cars) * alone[p + 1])[free])
    found: Any = linprog(
        np.append(np.zeros(columns - 1), -1.0), A_ub=sparse.vstack(rows), b_ub=np.concatenate(right),
        A_eq=sparse.block_diag([*motion, sparse.csr_array((0, 1))]), b_eq=np.zeros(2 * K * len(cars)),
        bounds=[*bounds, (None, None)], method="highs",
    )  # fmt: skip
    assert found.status == 0, found.message
    margin = min(-found.fun, fixed) if fixed < 0.0 else -found.fun
    return LinearVerdict(margin >= 0.0, abs(margin) > step**2 * np.max(braking + driving), margin)


def ways(speed: float, braking: float, onset: float, time: Floats) -> Floats:
    """How far a vehicle has come at each of the times if it coasts until its onset, then brakes to rest."""
    braked = np.clip(time - onset, 0.0, speed / braking)
    return np.minimum(time, onset) * speed + (speed - 0.5 * braking * braked) * braked
