"""Contact features: a vehicle forecasts its next impacts for its own full braking, coasting and full driving.

A forecast covers only the vehicles that the observer knows. The observer's own command takes effect after the
observer's latency. Every other vehicle keeps its present acceleration, with two exceptions. A vehicle without a command
in force is assumed to brake fully after its latency. A braking vehicle whose brakes build up gradually is also assumed
to brake fully, because its present deceleration does not show its command.

Arguments that several functions share: ``state`` has time, motion and harm, and ``params`` the parameters of the
vehicles, with one row per world (layout: ``physics.columns``). ``table`` has one world with one column per vehicle
(layout: ``physics.rows``) and, if there is an obstacle, column 0 for the obstacle. ``time_step`` is the time between
two decisions, s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.first_edition.game.features import CONTACT_COMMANDS, CONTACT_SIDES
from ethbrake_marl.first_edition.physics.columns import columns
from ethbrake_marl.first_edition.physics.contact_forecast import CONTACT, forecast_contacts
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.messages import knows_line
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.rows import FLAG, ROW, place_obstacle, place_rates
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

FORECAST_S = 10.0  # length of a forecast (s); without an impact, also the value of the feature time

_OF_PAIR, _HARMS = 4, 2  # number of features per pair, and number of features of the line's harm

_OF_COMMAND = len(CONTACT_SIDES) * _OF_PAIR + _HARMS

_NEAR = len(CONTACT_COMMANDS) * _OF_COMMAND  # number of columns of contact; the columns of contact_far follow

_FAR = len(CONTACT_SIDES) + _HARMS  # number of contact_far features per command


class Contacts(NamedTuple):
    """Arguments of ``observe_contacts``."""

    time_step_s: float  # time between two decisions (s)
    commands: Ints  # commands to forecast, as indices into CONTACT_COMMANDS
    # scaling, [3, 30], or [3, 42] with contact_far: rows 1 / scale, low and high, one column per contact feature
    features: Floats


@compiled
def observe_contacts(
    state: Floats, params: Floats, observers: Ints, time_step: float, commands: Ints, features: Floats,
    out: NDArray[np.float32], failed: Bools,
) -> None:  # fmt: skip
    """Write the contact features of each observer into ``out``; set ``failed`` for worlds in which a forecast failed.

    ``observers`` are indices of vehicles (0 = front). For ``commands`` and ``features``, see ``Contacts``. In ``out``,
    [n, observers, features], the features of commands that are not in ``commands`` do not change. ``failed`` [n]
    becomes True for each world in which a check of the physics failed.
    """
    of = columns(state)
    N, at = (
        of.vehicles,
        1 if state.shape[1] > of.obstacle else 0,
    )  # vehicle i has column at + i; an obstacle has column 0
    line, table = np.zeros((ROW.OF_BUILD_UP, N + at)), np.zeros((ROW.OF_BUILD_UP, N + at))
    contacts, value = np.zeros((CONTACT.WIDTH, N + at)), np.zeros(_OF_COMMAND + _FAR)
    no_pieces = np.zeros((N, 0))  # no vehicle knows the future commands of another vehicle's profile script
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
                _write_features(table, contacts, at + i, first, last, time_step, value)
                for f in range(_OF_COMMAND + _FAR if out.shape[2] > _NEAR else _OF_COMMAND):
                    column = c * _OF_COMMAND + f if f < _OF_COMMAND else _NEAR + c * _FAR + f - _OF_COMMAND
                    scaled = value[f] * features[0, column]
                    out[k, o, column] = min(max(scaled, features[1, column]), features[2, column])


@compiled
def _place_known(table: Floats, state: Floats, params: Floats, k: int, i: int, at: int) -> tuple[int, int]:
    """Write world ``k`` into ``table`` as vehicle ``i`` knows it; return the first and last column of the known
    vehicles.

    A vehicle is placed far away if vehicle ``i`` does not know this vehicle, or lacks data of this vehicle that a
    forecast needs. A known obstacle is placed in the same way as a known vehicle. ``at`` is 1 if ``table`` has a column
    for an obstacle, otherwise 0.
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
        elif known and in_force < 0.0 and params[k, of.brake_rate + j] < math.inf:  # its brakes may still build up
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
def _write_features(
    table: Floats, found: Floats, own: int, first: int, last: int, time_step: float, value: Floats
) -> None:
    """Compute the contact features of one forecast, before scaling, and write them into ``value``.

    The features of the observer and a neighbour are 0 if the neighbour is unknown or does not exist. An impact exactly
    at the end of a time step belongs to this time step, as in the engine.

    ``table`` has the world at the end of the forecast; the observer has the column ``own``, and the vehicles that it
    knows have the columns ``first`` to ``last``. ``found`` is the next impact of each pair, as ``forecast_contacts``
    returns it.
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
