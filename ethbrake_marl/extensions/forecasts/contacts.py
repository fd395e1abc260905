"""The feature group ``contact``: a vehicle's next impacts if it brakes, coasts or drives fully.

A forecast simulates, for ``FORECAST_S``, the unbroken row of known vehicles around the observer, without those that
cannot matter (``episode.reach``). There is no forecast for an observer that cannot predict a neighbour of which it
knows (its own ``know`` is then infinite): it reads as if nobody were known. The observer's command takes effect after
its latency. Every other vehicle keeps the present force of its brakes or engine, with two
exceptions: a vehicle without a force brakes fully after its latency, and a vehicle whose brakes build up is taken to
brake fully, since its force does not show its command.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.episode.commands import command_of
from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.features import Feature
from ethbrake_marl.episode.reach import row_within_reach
from ethbrake_marl.episode.state import TIME, State, require
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacity
from ethbrake_marl.motion.interval import EVENT_BY_EVENT, FAILED, move_line
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_ROWS,
    FAR_M,
    FORCE,
    GAP,
    HIT,
    LATENCY,
    LINE_ROWS,
    NEW_FIRST,
    NEW_TOTAL,
    NEXT_CLOSING,
    NEXT_TIME,
    OWN_LATENCY,
    SCRIPTED,
    SPEED,
    Floats,
    Ints,
    scratch_for,
)
from ethbrake_marl.registry import Part

FORECAST_S = 10.0
FORECAST_COMMANDS = {"brake": "full braking", "coast": "coasting", "drive": "full driving"}
SIDES = {"front": "the vehicle ahead", "rear": "the vehicle behind"}
# places of the features of `contact` for one command: those of an impact, for each side, then the harm
IMPACT_TIME, IMPACT_CLOSING, IMPACT_FRACTION, IMPACT_STEPS, PER_SIDE = range(5)
FIRST_HARM, TOTAL_HARM, PER_COMMAND = 2 * PER_SIDE, 2 * PER_SIDE + 1, 2 * PER_SIDE + 2


def contact_features(command: str, held: str) -> list[Feature]:
    features = []
    for side, where in SIDES.items():
        name, impact = f"{command}_{side}", f"forecast for {held}, first impact with {where}"
        features += [
            Feature(f"{name}_time", "s", 2.0, 0.0, 2.0, f"{impact}: time until this impact"),
            Feature(f"{name}_closing_speed", "m/s", 10.0, 0.0, 4.0, f"{impact}: closing speed; 0 without impact"),
            Feature(f"{name}_fraction", "1", 1.0, 0.0, 1.0, f"{impact}: time within its decision step, 0 to 1"),
            Feature(f"{name}_steps", "1", 10.0, 0.0, 2.0, f"{impact}: number of full decision steps before it"),
        ]
    for count in ("first_impact", "total"):
        about = f"forecast for {held}: {count.replace('_', '-')} harm of known pairs"
        features.append(Feature(f"{command}_{count}_harm", "m2/s2", 50.0, 0.0, 4.0, about))
    return features


CONTACT = tuple(feature for command, held in FORECAST_COMMANDS.items() for feature in contact_features(command, held))


@kernel
def known_line(line, car, clock, know, i, observer_line, parameters, commands):
    """Copy a world as body i knows it, with assumed commands of the others; return the first and last known body.

    ``line`` and ``car`` of the world, as ``clock`` and ``know`` in ``State``, are copied to ``observer_line`` and
    ``parameters``. The assumed commands (m/s2) are written to ``commands`` [N + 1]. Unknown bodies are at rest and out
    of reach, and like body i in all else.
    """
    first, last, time, predicts = i, i, clock[TIME], know[i, i] < math.inf
    nearest, farthest = row_within_reach(line, car, clock, know, i)
    while predicts and first > nearest and time >= know[i, first - 1]:
        first -= 1
    while predicts and last < farthest and time >= know[i, last + 1]:
        last += 1
    for j in range(line.shape[1]):
        inside, force = first <= j <= last, line[FORCE, j]
        for row in range(CAR_ROWS):  # the values of an unknown vehicle would cause other events, and other rounding
            parameters[row, j] = car[row, j if inside or j == 0 else i]
        parameters[SCRIPTED, j] = 0.0  # the assumed commands are nobody's script
        observer_line[SPEED, j] = line[SPEED, j] if inside else 0.0
        observer_line[FORCE, j] = force if inside else 0.0
        observer_line[GAP, j] = line[GAP, j] if first <= j < last else FAR_M
        observer_line[HIT, j] = line[HIT, j]
        parameters[LATENCY, j], commands[j] = 0.0, force if inside else 0.0
        if j == i or (inside and force == 0.0):
            parameters[LATENCY, j] = max(car[OWN_LATENCY, j] - time, 0.0)
            commands[j] = -capacity(car, BRAKING, j)
        elif inside and force < 0.0 and car[BRAKE_RATE, j] < math.inf:
            commands[j] = -capacity(car, BRAKING, j)
    if predicts and first == 1 and line[GAP, 0] < FAR_M:
        observer_line[GAP, 0], first = line[GAP, 0], 0
    return first, last


@large
def forecast_worlds(line, car, clock, know, observers, time_step_s, memory, out):
    """Write the features ``contact``, before scaling, to ``out`` [n, observers, F].

    Returns the index of a world in which the simulation failed, or -1. ``line``, ``car``, ``clock``, ``know``: as in
    ``State``. ``observers``: numbers of the observing bodies. ``memory``: arrays that are overwritten.
    """
    scratch, here, observer_line, parameters, commands = memory
    failed = -1
    for k in range(len(out)):
        for o in range(len(observers)):
            i = observers[o]
            first, last = known_line(line[k], car[k], clock[k], know[k], i, observer_line, parameters, commands)
            for c in range(3):
                for row in range(LINE_ROWS):
                    for j in range(here.shape[1]):
                        here[row, j] = observer_line[row, j]
                commands[i] = command_of(car[k], i, c - 1.0)
                outcome = move_line(here, parameters, commands, scratch, 0.0, FORECAST_S)
                if outcome == FAILED:
                    failed = k
                value = out[k, o, c * PER_COMMAND : (c + 1) * PER_COMMAND]
                has_impact = outcome == EVENT_BY_EVENT
                write_impacts(scratch, has_impact, i, first, last, time_step_s, value)
                value[FIRST_HARM] = value[TOTAL_HARM] = 0.0
                for p in range(first, last if has_impact else first):
                    value[FIRST_HARM] += scratch[NEW_FIRST, p]
                    value[TOTAL_HARM] += scratch[NEW_TOTAL, p]
    return failed


@kernel
def write_impacts(scratch, has_impact, i, first, last, time_step_s, value):
    """Write the features of body i's first impacts in one forecast to ``value``; features of an unknown pair are 0.

    ``scratch``: results of the forecast's simulation. ``has_impact``: whether this simulation contains an impact.
    ``first``, ``last``: first and last known body. An impact exactly at the end of a time step belongs to this step, as
    in an episode.
    """
    for side in range(2):
        p, impact = i - 1 + side, value[side * PER_SIDE : (side + 1) * PER_SIDE]
        impact[:] = 0.0
        if first <= p < last:
            time = scratch[NEXT_TIME, p] if has_impact else math.inf
            hit = time < math.inf
            steps = (time if hit else FORECAST_S) / time_step_s
            full_steps = max(math.ceil(steps) - 1.0, 0.0)
            impact[IMPACT_TIME] = time if hit else FORECAST_S
            impact[IMPACT_CLOSING] = scratch[NEXT_CLOSING, p] if hit else 0.0
            impact[IMPACT_FRACTION] = steps - full_steps if hit else 0.0
            impact[IMPACT_STEPS] = full_steps


def _forecasts(state: State, observers: Ints, time_step_s: float) -> Floats:
    """Features ``contact`` before scaling, [n, observers, F].

    Raises ``PhysicsError`` if a simulation fails.
    """
    require(state, "a forecast of contacts", SHOWN)
    bodies = state.wanted.shape[1]
    out = np.empty((state.n, len(observers), len(CONTACT)))
    line, observer_line, parameters = (np.zeros((rows, bodies)) for rows in (LINE_ROWS, LINE_ROWS, CAR_ROWS))
    memory = scratch_for(bodies), line, observer_line, parameters, np.zeros(bodies)
    failed = forecast_worlds(state.line, state.car, state.clock, state.know, observers, time_step_s, memory, out)
    if failed >= 0:
        raise PhysicsError({failed: f"a forecast of contacts failed before the end of its {FORECAST_S:g} s"})
    return out


GROUP = Part(CONTACT, _forecasts)
