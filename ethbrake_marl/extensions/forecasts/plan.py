"""The feature group ``plan``, and the agent of this name: the best constant braking for the vehicles that are known.

At every decision, nine constant brakings from full braking to coasting are simulated in the forecast of ``contacts``,
and then nine between the neighbours of the best. The plan is the one of least honest cost of the known pairs; of equal
ones, the middle one. If the forecast has nobody else, the plan is full braking. The agent applies it until the next
decision, and plans anew: receding-horizon control with constant commands. Its objective, the least impact energy of a
line, is that of coordinated brake control (Lu, Wang, Li and Zheng, Mathematical Problems in Engineering 2014, article
192175; Wang, Li, Zheng and Lu, Integrated Computer-Aided Engineering 22, 2015, pages 171-185).
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.episode.commands import command_of
from ethbrake_marl.episode.counts import HONEST, amount_so_far
from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.features import Feature
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.episode.step import note_motion
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.extensions.forecasts.contacts import (
    FORECAST_S,
    PER_SIDE,
    SIDES,
    impact_features,
    known_line,
    write_impacts,
)
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacity
from ethbrake_marl.motion.interval import EVENT_BY_EVENT, FAILED, move_line
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_ROWS,
    LINE_ROWS,
    RELEASE_RATE,
    Floats,
    Ints,
    scratch_for,
)
from ethbrake_marl.registry import Part

TRIALS, LEVELS = 9, 2  # brakings of one search, and searches
SAME_COST = 1e-6  # costs that differ by less are equal (m2/s2)
COMMANDS = {"best": "the plan", "brake": "full braking", "coast": "coasting"}
COST = 2 * PER_SIDE  # place of the cost among the features of a command, after those of the impacts
PER_COMMAND = COST + 1


def _of_command(command: str, held: str) -> list[Feature]:
    cost = Feature(f"{command}_speed", "m/s", 10.0, 0.0, 6.0, f"forecast for {held}: square root of the honest cost")
    return [*impact_features(command, held), cost]


PLAN = (
    Feature("action", "1", 1.0, -1.0, 0.0, "constant braking of least forecast honest cost; -1 is full braking"),
    *(feature for command, held in COMMANDS.items() for feature in _of_command(command, held)),
    *(
        Feature(f"{vehicle}_{change}_time", "s", 1.0, 0.0, 4.0, f"time for a full {change} of the brakes of {whose}")
        for vehicle, whose in {"own": "this vehicle", **SIDES}.items()
        for change in ("build_up", "release")
    ),
)
FORECAST = (Feature("known", "1", 1.0, 0.0, 1.0, "0 if a neighbour of which this vehicle knows cannot be predicted"),)


@large
def plan_worlds(line, car, clock, know, observers, time_step_s, weights, memory, out):
    """Write the features ``plan`` and ``forecast``, before scaling, to ``out`` [n, observers, F].

    Returns the index of a world in which the simulation failed, or -1. ``line``, ``car``, ``clock``, ``know``: as in
    ``State``. ``observers``: numbers of the observing bodies. ``weights``: of the cost (``episode.counts``).
    ``memory``: arrays that are overwritten.
    """
    scratch, here, observer_line, parameters, commands, trials, costs = memory
    failed = -1
    for k in range(len(out)):
        for o in range(len(observers)):
            i, value = observers[o], out[k, o]
            first, last = known_line(line[k], car[k], clock[k], know[k], i, observer_line, parameters, commands)
            middle, spacing = -0.5, 1.0 / (TRIALS - 1)
            for level in range(LEVELS):
                for c in range(TRIALS):
                    for row in range(LINE_ROWS):
                        for j in range(here.shape[1]):
                            here[row, j] = observer_line[row, j]
                    action = min(max(middle + spacing * (c - TRIALS // 2), -1.0), 0.0)
                    commands[i] = command_of(car[k], i, action)
                    outcome = move_line(here, parameters, commands, scratch, 0.0, FORECAST_S)
                    if outcome == FAILED:
                        failed = k
                    note_motion(here, parameters)
                    write_impacts(scratch, outcome == EVENT_BY_EVENT, i, first, last, time_step_s, trials[c])
                    costs[c] = amount_so_far(here, weights)
                    trials[c, COST] = math.sqrt(costs[c])
                best = middle_of_least(costs) if first < last else 0
                middle = min(max(middle + spacing * (best - TRIALS // 2), -1.0), 0.0)
                spacing /= TRIALS // 2
                for part in range(PER_COMMAND):
                    value[1 + part] = trials[best, part]
                    if level == 0:
                        value[1 + PER_COMMAND + part] = trials[0, part]
                        value[1 + 2 * PER_COMMAND + part] = trials[TRIALS - 1, part]
            value[0], f = middle, 1 + 3 * PER_COMMAND
            for j in (i, i - 1, i + 1):
                is_known = max(first, 1) <= j <= last
                for rate in (BRAKE_RATE, RELEASE_RATE):
                    value[f] = capacity(car[k], BRAKING, j) / car[k, rate, j] if is_known else 0.0
                    f += 1
            value[f] = 1.0 if know[k, i, i] < math.inf else 0.0
    return failed


@kernel
def middle_of_least(costs):
    """Index of the middle one of the least ``costs``."""
    least, ties = math.inf, 0
    for c in range(len(costs)):
        least = min(least, costs[c] + SAME_COST)
    for c in range(len(costs)):
        ties += 1 if costs[c] <= least else 0
    for c in range(len(costs)):
        ties -= 2 if costs[c] <= least else 0
        if ties <= 0:
            return c
    return 0


def _plans(state: State, observers: Ints, time_step_s: float) -> Floats:
    """Features ``plan`` and ``forecast`` before scaling, [n, observers, F].

    Raises ``PhysicsError`` if a simulation fails.
    """
    require(state, "a plan", SHOWN)
    bodies = state.wanted.shape[1]
    out = np.empty((state.n, len(observers), len(PLAN + FORECAST)))
    line, observer_line, parameters = (np.zeros((rows, bodies)) for rows in (LINE_ROWS, LINE_ROWS, CAR_ROWS))
    trials, costs = np.zeros((TRIALS, PER_COMMAND)), np.zeros(TRIALS)
    memory = scratch_for(bodies), line, observer_line, parameters, np.zeros(bodies), trials, costs
    failed = plan_worlds(
        state.line, state.car, state.clock, state.know, observers, time_step_s, HONEST.weights, memory, out
    )
    if failed >= 0:
        raise PhysicsError({failed: f"the forecast of a plan failed before the end of its {FORECAST_S:g} s"})
    return out


GROUP = Part(PLAN, _plans, slice(0, len(PLAN)))
FORECAST_GROUP = Part(FORECAST, _plans, slice(len(PLAN), None))  # apart, so that `plan` keeps its length
