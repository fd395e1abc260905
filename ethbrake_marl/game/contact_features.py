"""Contact features: the next impacts that a vehicle forecasts under three commands of its own.

The vehicle considers the part of the line that it knows, as in its other features. It forecasts full braking, coasting
and full driving of its own, which start once its own latency has elapsed. Every other vehicle of that part keeps its
observed command. A vehicle without a command in force is assumed to brake fully once its latency has elapsed. So is a
vehicle whose brakes build up and that brakes, because the present force does not show its command.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.game.features import CONTACT_COMMANDS, CONTACT_SIDES
from ethbrake_marl.physics.columns import columns
from ethbrake_marl.physics.contact_forecast import CONTACT, forecast_contacts
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.messages import knows_line
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.rows import FLAG, ROW, place_obstacle, place_rates
from ethbrake_marl.physics.state import Bools, Floats, Ints

FORECAST_S = 10.0  # length of a forecast (s); also the reported time if there is no impact

_OF_PAIR, _HARMS = 4, 2  # number of features per pair, and of the line

_OF_COMMAND = len(CONTACT_SIDES) * _OF_PAIR + _HARMS

_NEAR = len(CONTACT_COMMANDS) * _OF_COMMAND  # number of columns of contact; those of contact_far follow

_FAR = len(CONTACT_SIDES) + _HARMS  # number of contact_far features per command


class Contacts(NamedTuple):
    """Which contact features to compute, and their scaling."""

    time_step_s: float  # time between two decisions (s)
    commands: Ints  # commands to forecast, as indices into CONTACT_COMMANDS
    # [3, 30], or [3, 42] with contact_far: rows 1 / scale, low and high; a column per contact feature
    features: Floats


@compiled
def observe_contacts(
    state: Floats, params: Floats, observers: Ints, time_step: float, commands: Ints, features: Floats,
    out: NDArray[np.float32], failed: Bools,
) -> None:  # fmt: skip
    """Fill ``out`` [n, observers, features] with contact features, and set ``failed`` [n] where the kernel failed.

    Args:
        state: state rows of the worlds, [n, S], in the layout of ``physics.columns``.
        params: their parameter rows.
        observers: indices of the observing vehicles.
        time_step: time between two decisions, s.
        commands: commands to forecast, as indices into CONTACT_COMMANDS.
        features: scaling, [3, 30], or [3, 42] with contact_far: rows 1 / scale, low and high, a column per feature.
        out: result; columns of commands that are not forecast stay as they are.
        failed: set to True where a check of the kernel failed, [n].

    """
    of = columns(state)
    N, at = (
        of.vehicles,
        1 if state.shape[1] > of.obstacle else 0,
    )  # vehicle i is column at + i; an obstacle is column 0
    line, table = np.zeros((ROW.OF_BUILD_UP, N + at)), np.zeros((ROW.OF_BUILD_UP, N + at))
    contacts, value = np.zeros((CONTACT.WIDTH, N + at)), np.zeros(_OF_COMMAND + _FAR)
    no_pieces = np.zeros((N, 0))  # no vehicle knows the future pieces of another one
    for k in range(out.shape[0]):
        for o in range(observers.shape[0]):
            i = observers[o]
            first, last = _place_known(line, state, params, k, i, at)
            brake_rate, release_rate = of.brake_rate, of.release_rate
            place_rates(
                table, params[k, brake_rate : brake_rate + N], params[k, release_rate : release_rate + N], no_pieces
            )
            for c in commands:
                for j in range(N + at):
                    for row in (ROW.SPEED, ROW.COMMAND, ROW.MASS, ROW.LIMIT, ROW.ONSET, ROW.GAP, ROW.HIT):
                        table[row, j] = line[row, j]
                    table[ROW.FORCE, j] = line[ROW.FORCE, j]
                table[ROW.COMMAND, at + i] = 0.0
                if c == 0:
                    table[ROW.COMMAND, at + i] = -params[k, of.braking + i]
                elif c == 2:
                    table[ROW.COMMAND, at + i] = params[k, of.driving + i]
                if forecast_contacts(table, params[k, of.restitution], FORECAST_S, contacts) != FLAG.DONE:
                    failed[k] = True
                    break
                _tell(table, contacts, at + i, first, last, time_step, value)
                for f in range(_OF_COMMAND + _FAR if out.shape[2] > _NEAR else _OF_COMMAND):
                    column = c * _OF_COMMAND + f if f < _OF_COMMAND else _NEAR + c * _FAR + f - _OF_COMMAND
                    scaled = value[f] * features[0, column]
                    out[k, o, column] = min(max(scaled, features[1, column]), features[2, column])


@compiled
def _place_known(table: Floats, state: Floats, params: Floats, k: int, i: int, at: int) -> tuple[int, int]:
    """Write the part of a world that a vehicle knows into a table; return the first and last column that it knows.

    Unknown vehicles are placed far away, and so are those of which a piece is unknown that a forecast needs. If an
    obstacle is known, it is the first column.

    Args:
        table: table to fill, in the layout of ``physics.rows``, [rows, N + at].
        state: state rows of the worlds, [n, S], in the layout of ``physics.columns``.
        params: their parameter rows.
        k: row of the world.
        i: index of the vehicle.
        at: 1 if the rows have an obstacle, which is then column 0 of the table; otherwise 0.

    """
    of = columns(state)
    N, speed, command, gap, obstacle = of.vehicles, of.speed, of.command, of.gap, of.obstacle
    braking, latency, mass, limit, news = of.braking, of.latency, of.mass, of.limit, of.news
    by_link, time = params.shape[1] > of.own_latency, state[k, of.time]
    own_part = of.own_latency if by_link else latency
    first, last, messages = i, i, params[k, of.messages :]
    while first > 0 and time >= params[k, news + i * N + first - 1 if by_link else latency + i]:
        if not knows_line(messages, N, i, first - 1, time):
            break
        first -= 1
    while last < N - 1 and time >= params[k, news + i * N + last + 1 if by_link else latency + i]:
        if not knows_line(messages, N, i, last + 1, time):
            break
        last += 1
    for j in range(N):
        known = first <= j <= last
        in_force = state[k, command + j]
        table[ROW.SPEED, at + j] = state[k, speed + j] if known else 0.0
        table[ROW.MASS, at + j] = params[k, mass + j]
        table[ROW.LIMIT, at + j] = params[k, limit + j]
        table[ROW.ONSET, at + j] = 0.0
        table[ROW.COMMAND, at + j] = in_force if known else 0.0
        if j == i or in_force == 0.0:
            table[ROW.ONSET, at + j] = max(params[k, own_part + j] - time, 0.0)
            table[ROW.COMMAND, at + j] = -params[k, braking + j] if known else 0.0
        elif known and in_force < 0.0 and params[k, of.brake_rate + j] < math.inf:  # its force may still be building up
            table[ROW.COMMAND, at + j] = -params[k, braking + j]
        table[ROW.FORCE, at + j] = in_force if known else 0.0
        if j < N - 1:
            table[ROW.GAP, at + j] = state[k, gap + j] if first <= j < last else BOUND.FAR_AWAY_M
            table[ROW.HIT, at + j] = state[k, gap + N - 1 + j]
    if at == 1:
        seen = first == 0 and state[k, obstacle] < math.inf
        place_obstacle(table, state[k, obstacle] if seen else BOUND.FAR_AWAY_M, state[k, obstacle + 1])
        return (0 if seen else 1 + first), 1 + last
    return first, last


@compiled
def _tell(table: Floats, found: Floats, own: int, first: int, last: int, time_step: float, value: Floats) -> None:
    """Compute the unscaled contact features of one forecast into ``value``.

    A feature is 0 for a pair whose other vehicle is unknown or does not exist. An impact at the very end of a decision
    step belongs to that step, as in the engine.

    Args:
        table: the world after the forecast, in the layout of ``physics.rows``.
        found: next impact of each pair, as ``forecast_contacts`` wrote it.
        own: column of the observing vehicle.
        first: first column that the vehicle knows.
        last: last column that it knows.
        time_step: time between two decisions, s.
        value: result.

    """
    for side in range(2):
        p, at = own - 1 + side, side * _OF_PAIR
        if not first <= p < last:
            for f in range(_OF_PAIR):
                value[at + f] = 0.0
            continue
        time = found[CONTACT.TIME, p]
        met = time < math.inf
        steps = (time if met else FORECAST_S) / time_step
        whole = max(math.ceil(steps) - 1.0, 0.0)
        value[at] = time if met else FORECAST_S
        value[at + 1] = found[CONTACT.CLOSING, p]
        value[at + 2] = steps - whole if met else 0.0
        value[at + 3] = whole
    first_harm, total_harm = 0.0, 0.0
    for p in range(first, last):
        first_harm += table[ROW.FIRST_HARM, p]
        total_harm += table[ROW.TOTAL_HARM, p]
    value[2 * _OF_PAIR] = first_harm
    value[2 * _OF_PAIR + 1] = total_harm
    value[_OF_COMMAND], value[_OF_COMMAND + 1] = value[0], value[_OF_PAIR]
    value[_OF_COMMAND + 2], value[_OF_COMMAND + 3] = math.sqrt(first_harm), math.sqrt(total_harm)
