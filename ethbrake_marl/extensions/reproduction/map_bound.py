"""In which worlds does every strategy collide in the paper's fixed-step map? A linear programme decides.

Variables are the speeds v_n of Vehicle 2 at each sample n. With the time step h, its way is h times the sum of the mean
speeds of the steps. Constraints, for every sample until the vehicles around it stand:

    v_n - v_{n-1} <= h a_u,  v_{n-1} - v_n <= h a_l,  0 <= v_n <= v_max,  gap_n >= 0 of both pairs

This is the paper's own indicator (equation gamma): a pair that overlaps at a sample has collided, whatever its speeds.
Vehicles 1 and 3 brake as without impacts. If no speeds satisfy the constraints, every strategy collides in this world.
Samples after the vehicles around Vehicle 2 stand are left out, which can only lower the bound. scipy solves the
programme by HiGHS.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.reproduction.paper_map import sample
from ethbrake_marl.extensions.reproduction.readings import Reading
from ethbrake_marl.extensions.reproduction.strategies import VEHICLE_2, open_reading
from ethbrake_marl.motion.layout import BRAKING, DRIVING, GAP, LIMIT, SPEED, Bools, Floats

APART_M = 1e6  # gap without contact
INFEASIBLE = 2  # status of scipy's ``linprog``
VEHICLES = np.array([1, 3])  # bodies around Vehicle 2


@cache
def collides_in_map(reading: Reading, episodes: int) -> Bools:
    """[n]: every strategy has an overlap at a sample."""
    from scipy.optimize import linprog  # imported here, because it takes a second to load

    _, game, alert = open_reading(reading, episodes)
    state, h = game.reset(alert), game.settings.time_step_s
    ways = ways_around(state, h)
    samples, collides = ways.shape[2], np.zeros(episodes, np.bool_)
    identity = np.eye(samples)
    way, change = h * (np.tril(np.ones((samples, samples))) - 0.5 * identity), identity - np.eye(samples, k=-1)
    matrix = np.block([[way], [-way], [change], [-change]])
    for k in range(episodes):
        car, first = state.car[k, :, VEHICLE_2], np.zeros(samples)
        first[0] = state.line[k, SPEED, VEHICLE_2]
        begun = 0.5 * h * first[0]
        gaps = state.line[k, GAP, 1] + ways[k, 0] - begun, state.line[k, GAP, 2] - ways[k, 1] + begun
        most = np.concatenate([*gaps, first + h * car[DRIVING], h * car[BRAKING] - first])
        programme: Any = linprog(np.zeros(samples), A_ub=matrix, b_ub=most, bounds=(0.0, car[LIMIT]))
        collides[k] = programme.status == INFEASIBLE  # undecided worlds count as avoidable
    return collides


def ways_around(state: State, step_s: float) -> Floats:
    """Ways (m) of Vehicles 1 and 3 at each sample until both stand, without impacts, [n, 2, samples].

    Both vehicles brake fully from their latencies on. ``state``: at the first decision.
    """
    line, way = state.line.copy(), np.zeros((state.n, 2))
    line[:, GAP, 1:-1] = APART_M
    alone, ways = state._replace(line=line, wanted=-state.car[:, BRAKING]), []
    while alone.line[:, SPEED, VEHICLES].any():
        after = sample(alone, step_s)
        way = way + 0.5 * step_s * (alone.line[:, SPEED, VEHICLES] + after.line[:, SPEED, VEHICLES])
        alone = after
        ways.append(way)
    return np.stack(ways, axis=2)
