"""The contact features: what three forecasts of the vehicle's own command say of its next impacts.

The vehicle looks at the part of the line around it whose news it has, as its other features tell it. It goes on, once
its own latency has elapsed, with full braking, coasting or full driving. Every other vehicle of that part goes on with
the command that is observed of it; one of which none is in force brakes fully as soon as its latency has elapsed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.contact_forecast import CONTACT_CLOSING, CONTACT_ROWS, CONTACT_TIME, forecast_contacts
from ethbrake_marl.physics.impact import GAP, MASS, SPEED
from ethbrake_marl.physics.obstacle import FAR_AWAY_M, place_obstacle
from ethbrake_marl.physics.rows import (
    RESTITUTION,
    TIME,
    command_at,
    gap_at,
    has_news,
    params_at,
    speed_at,
    state_width,
    vehicles_in,
)
from ethbrake_marl.physics.segment import COMMAND, DONE, FIRST_HARM, HIT, LIMIT, ONSET, TABLE_ROWS, TOTAL_HARM
from ethbrake_marl.scenario.features import CONTACT_COMMANDS, CONTACT_FAR_FEATURES, CONTACT_FEATURES, CONTACT_SIDES

FORECAST_S = 10.0  # how far the forecasts look; also the time to an impact that never comes
_OF_PAIR, _HARMS = 4, 2  # numbers of each pair; of the line
_OF_COMMAND = len(CONTACT_SIDES) * _OF_PAIR + _HARMS
_NEAR = len(CONTACT_COMMANDS) * _OF_COMMAND  # columns of contact; behind them are those of contact_far
_FAR = len(CONTACT_SIDES) + _HARMS  # numbers of contact_far for each command


class Contacts(NamedTuple):
    """Which contact features are wanted, and how they are scaled."""

    time_step_s: float  # between two decisions
    commands: Ints  # those to forecast, as places in CONTACT_COMMANDS
    features: Floats  # [3, 30], with far [3, 42]: 1 / scale, low, high of every contact feature


def contacts_of(names: set[str], time_step_s: float | None, *, far: bool = False) -> Contacts:
    """What to forecast for these contact features (names in their groups); ``far``: contact_far too.

    Raises ``InvalidInput`` without a time step.
    """
    if time_step_s is None:
        raise InvalidInput(
            "observation: contact features need the time between two decisions; give it as time_step_s, for instance"
            " eb.choose_observation([...], time_step_s=scenario.time_step_s)"
        )
    wanted = [c for c, command in enumerate(CONTACT_COMMANDS) if any(n.startswith(f"{command}_") for n in names)]
    features = CONTACT_FEATURES + CONTACT_FAR_FEATURES if far else CONTACT_FEATURES
    scaling = [[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]]
    return Contacts(time_step_s, np.array(wanted, np.int64), np.array(scaling))


def observe_contacts(state: Floats, params: Floats, vehicles: Ints, contacts: Contacts) -> NDArray[np.float32]:
    """All contact features of several vehicles in worlds given as rows of ``physics.rows``, scaled, [n, vehicles, C].

    C is 30, and 42 with those of contact_far.

    Those of commands that are not wanted are 0. Raises ``PhysicsError`` naming the worlds in which a forecast failed.
    """
    found = np.zeros((len(state), len(vehicles), contacts.features.shape[1]), np.float32)
    failed = np.zeros(len(state), np.bool_)
    _observe_contacts(state, params, vehicles, *contacts, found, failed)
    if failed.any():
        reason = f"a forecast of contacts could not look {FORECAST_S:g} s ahead"
        raise PhysicsError({k: reason for k in np.flatnonzero(failed).tolist()})
    return found


@compiled
def _observe_contacts(
    state: Floats, params: Floats, observers: Ints, time_step: float, commands: Ints, features: Floats,
    out: NDArray[np.float32], failed: Bools,
) -> None:  # fmt: skip
    """Fill ``out``, and ``failed`` [n] where a check of the kernel failed."""
    N = vehicles_in(state)
    at = 1 if state.shape[1] > state_width(N) else 0  # vehicle i stands in column at + i, behind an obstacle
    line, table = np.zeros((TABLE_ROWS, N + at)), np.zeros((TABLE_ROWS, N + at))
    found, value = np.zeros((CONTACT_ROWS, N + at)), np.zeros(_OF_COMMAND + _FAR)
    braking, driving = params_at(0, N), params_at(1, N)
    for k in range(out.shape[0]):
        for o in range(observers.shape[0]):
            i = observers[o]
            first, last = _place_known(line, state, params, k, i, at)
            for c in commands:
                for j in range(N + at):
                    for row in (SPEED, COMMAND, MASS, LIMIT, ONSET, GAP, HIT):
                        table[row, j] = line[row, j]
                table[COMMAND, at + i] = 0.0
                if c == 0:
                    table[COMMAND, at + i] = -params[k, braking + i]
                elif c == 2:
                    table[COMMAND, at + i] = params[k, driving + i]
                if forecast_contacts(table, params[k, RESTITUTION], FORECAST_S, found) != DONE:
                    failed[k] = True
                    break
                _tell(table, found, at + i, first, last, time_step, value)
                for f in range(_OF_COMMAND + _FAR if out.shape[2] > _NEAR else _OF_COMMAND):
                    column = c * _OF_COMMAND + f if f < _OF_COMMAND else _NEAR + c * _FAR + f - _OF_COMMAND
                    scaled = value[f] * features[0, column]
                    out[k, o, column] = min(max(scaled, features[1, column]), features[2, column])


@compiled
def _place_known(table: Floats, state: Floats, params: Floats, k: int, i: int, at: int) -> tuple[int, int]:
    """Write world k, as vehicle i knows it, into a table; its first and last columns that are known.

    Whoever is not known stands far away. Where an obstacle is known, it is the first column.
    """
    N = vehicles_in(state)
    speed, command, gap = speed_at(N), command_at(N), gap_at(N)
    braking, latency, mass, limit, news = (
        params_at(0, N), params_at(2, N), params_at(3, N), params_at(4, N), params_at(6, N),
    )  # fmt: skip
    by_link, time = has_news(params, N), state[k, TIME]
    own_part = params_at(5, N) if by_link else latency
    first, last = i, i
    while first > 0 and time >= params[k, news + i * N + first - 1 if by_link else latency + i]:
        first -= 1
    while last < N - 1 and time >= params[k, news + i * N + last + 1 if by_link else latency + i]:
        last += 1
    for j in range(N):
        known = first <= j <= last
        in_force = state[k, command + j]
        table[SPEED, at + j] = state[k, speed + j] if known else 0.0
        table[MASS, at + j] = params[k, mass + j]
        table[LIMIT, at + j] = params[k, limit + j]
        table[ONSET, at + j] = 0.0
        table[COMMAND, at + j] = in_force if known else 0.0
        if j == i or in_force == 0.0:
            table[ONSET, at + j] = max(params[k, own_part + j] - time, 0.0)
            table[COMMAND, at + j] = -params[k, braking + j] if known else 0.0
        if j < N - 1:
            table[GAP, at + j] = state[k, gap + j] if first <= j < last else FAR_AWAY_M
            table[HIT, at + j] = state[k, gap + N - 1 + j]
    if at == 1:
        obstacle = state_width(N)
        seen = first == 0 and state[k, obstacle] < math.inf
        place_obstacle(table, state[k, obstacle] if seen else FAR_AWAY_M, state[k, obstacle + 1])
        return (0 if seen else 1 + first), 1 + last
    return first, last


@compiled
def _tell(table: Floats, found: Floats, own: int, first: int, last: int, time_step: float, value: Floats) -> None:
    """The numbers of one forecast before scaling; 0 for a pair whose other vehicle is not known, or not there.

    An impact at the very end of a decision step belongs to that step, as in the engine.
    """
    for side in range(2):
        p, at = own - 1 + side, side * _OF_PAIR
        if not first <= p < last:
            for f in range(_OF_PAIR):
                value[at + f] = 0.0
            continue
        time = found[CONTACT_TIME, p]
        met = time < math.inf
        steps = (time if met else FORECAST_S) / time_step
        whole = max(math.ceil(steps) - 1.0, 0.0)
        value[at] = time if met else FORECAST_S
        value[at + 1] = found[CONTACT_CLOSING, p]
        value[at + 2] = steps - whole if met else 0.0
        value[at + 3] = whole
    first_harm, total_harm = 0.0, 0.0
    for p in range(first, last):
        first_harm += table[FIRST_HARM, p]
        total_harm += table[TOTAL_HARM, p]
    value[2 * _OF_PAIR] = first_harm
    value[2 * _OF_PAIR + 1] = total_harm
    value[_OF_COMMAND], value[_OF_COMMAND + 1] = value[0], value[_OF_PAIR]
    value[_OF_COMMAND + 2], value[_OF_COMMAND + 3] = math.sqrt(first_harm), math.sqrt(total_harm)
