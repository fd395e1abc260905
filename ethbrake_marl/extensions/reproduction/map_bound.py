"""In which worlds does every strategy collide in the paper's fixed-step map? A mixed-integer linear programme decides.

Variables are the speed v_n of Vehicle 2 at each sample n and, for each of its two pairs, a binary z_n that is 1 if the
pair may overlap at the sample. With the time step h, the way x_n of Vehicle 2 is h times the sum of the mean speeds of
the steps. Constraints, for every sample until the vehicles around it stand:

    v_n - v_{n-1} <= h a_u,  v_{n-1} - v_n <= h a_l,  0 <= v_n <= v_max
    gap_n >= -M z_n,  closing_n <= W (1 - z_n)

The second line excludes impacts: the map has one where a pair overlaps and its closing speed is above 0, so an overlap
without an impact must separate. M and W are larger than any overlap and closing speed. Vehicles 1 and 3 brake as
without impacts. If no speeds satisfy the constraints, every strategy has an impact in this world. Samples after the
vehicles around Vehicle 2 stand are left out, which can only lower the bound. scipy solves the programme by HiGHS.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.reproduction.paper_map import sample
from ethbrake_marl.extensions.reproduction.random_test import VEHICLE_2, WORLD_FIELDS, open_reading
from ethbrake_marl.extensions.reproduction.readings import Reading
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import BRAKING, DRIVING, GAP, LIMIT, SPEED, Bools, Floats

OVERLAP_M, CLOSING_MPS = 10.0, 100.0  # M and W
APART_M = 1e6  # gap without contact
INFEASIBLE = 2  # status of scipy's ``milp``
VEHICLES = np.array([1, 3])  # bodies around Vehicle 2


@cache
def collides_in_map(reading: Reading, episodes: int) -> Bools:
    """[n]: every strategy has an impact."""
    from scipy.optimize import Bounds, LinearConstraint, milp  # imported here, because it takes a second to load
    from scipy.sparse import csr_matrix

    _, game, alert = open_reading(reading.only(*WORLD_FIELDS), episodes)
    state, h = game.reset(alert), game.settings.time_step_s
    ways, speeds = braking_around(state, h)
    samples = ways.shape[2]
    identity, zeros = np.eye(samples), np.zeros((samples, samples))
    way, change = h * (np.tril(np.ones((samples, samples))) - 0.5 * identity), identity - np.eye(samples, k=-1)
    overlap, closing = OVERLAP_M * identity, CLOSING_MPS * identity
    rows = [[way, -overlap, zeros], [-way, zeros, -overlap]]
    rows += [[identity, closing, zeros], [-identity, zeros, closing], [change, zeros, zeros]]
    matrix, binary = csr_matrix(np.block(rows)), np.repeat([0, 1], [samples, 2 * samples])
    unbounded, collides = np.full(4 * samples, -np.inf), np.zeros(episodes, np.bool_)
    for k in range(episodes):
        car, first = state.car[k, :, VEHICLE_2], np.zeros(samples)
        first[0] = state.line[k, SPEED, VEHICLE_2]
        begun = 0.5 * h * first[0]
        gaps = state.line[k, GAP, 1] + ways[k, 0] - begun, state.line[k, GAP, 2] - ways[k, 1] + begun
        most_closing = speeds[k, 0] + CLOSING_MPS + TOUCH_MPS, CLOSING_MPS + TOUCH_MPS - speeds[k, 1]
        most = np.concatenate([*gaps, *most_closing, first + h * car[DRIVING]])
        least = np.concatenate([unbounded, first - h * car[BRAKING]])
        top = np.where(binary, 1.0, car[LIMIT])
        programme: Any = milp(
            np.zeros(3 * samples), integrality=binary, bounds=Bounds(0.0, top),
            constraints=LinearConstraint(matrix, least, most),
        )  # fmt: skip
        collides[k] = programme.status == INFEASIBLE  # undecided worlds count as avoidable
    return collides


def braking_around(state: State, step_s: float) -> tuple[Floats, Floats]:
    """Ways (m) and speeds (m/s) of Vehicles 1 and 3 at each sample until both stand, without impacts, [n, 2, samples].

    Both vehicles brake fully from their latencies on. ``state``: at the first decision.
    """
    line, way = state.line.copy(), np.zeros((state.n, 2))
    line[:, GAP, 1:-1] = APART_M
    alone, ways, speeds = state._replace(line=line, wanted=-state.car[:, BRAKING]), [], []
    while alone.line[:, SPEED, VEHICLES].any():
        after = sample(alone, step_s)
        way = way + 0.5 * step_s * (alone.line[:, SPEED, VEHICLES] + after.line[:, SPEED, VEHICLES])
        alone = after
        ways.append(way)
        speeds.append(after.line[:, SPEED, VEHICLES])
    return np.stack(ways, axis=2), np.stack(speeds, axis=2)
