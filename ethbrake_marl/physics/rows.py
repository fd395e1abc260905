"""One row per world: the layout in which worlds are kept while they run.

The engine steps thousands of worlds, or one world thousands of times. Two arrays (state and parameters) are then far
cheaper to hand to a kernel, to copy and to replace row by row than a dozen. ``Worlds`` stays what everybody else sees.

Columns, for N vehicles and P = N - 1 pairs; the ``_at`` functions give the first column of each group:

state   time, speeds N, commands in force N, commands in force before N, gaps P, hit flags P; and since the
        episode began: first-impact harm P, total harm P, impacts P; and, where worlds have an obstacle ahead: gap to it
        (infinite: none), hit flag, and since the episode began: first-impact harm, total harm, impacts
params  restitution, braking N, driving N, latency N, mass N, speed limit N; and, where news comes link by link: own
        latency N, and from when on vehicle i acts on news of vehicle j, N * N columns (without them latencies are all
        own, and everything is known from them on); and, where messages are periodic, the columns of
        ``physics.messages``, which change as messages come in
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.advance import no_obstacle_harm
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.obstacle import obstacle_ahead
from ethbrake_marl.physics.segment import ROW_WIDTH
from ethbrake_marl.physics.worlds import (
    Floats,
    Ints,
    Vehicles,
    Worlds,
    is_known_at_once,
    known_at_once,
    vehicles_at_once,
)

TIME = 0
RESTITUTION = 0
OBSTACLE_WIDTH = 5


@compiled
def speed_at(vehicles: int) -> int:
    """First column of the speeds (m/s)."""
    return 1


@compiled
def command_at(vehicles: int) -> int:
    """First column of the commands in force (m/s2)."""
    return 1 + vehicles


@compiled
def previous_at(vehicles: int) -> int:
    """First column of the commands in force before the last segment (m/s2)."""
    return 1 + 2 * vehicles


@compiled
def gap_at(vehicles: int) -> int:
    """First column of the gaps (m); those of the hit flags and of the harm follow, P columns each."""
    return 1 + 3 * vehicles


@compiled
def harm_at(vehicles: int) -> int:
    """First column of first-impact harm; total harm and impacts follow, P columns each."""
    return 1 + 3 * vehicles + 2 * (vehicles - 1)


@compiled
def state_width(vehicles: int) -> int:
    """Columns of the state without an obstacle; with one, OBSTACLE_WIDTH more follow."""
    return 1 + 3 * vehicles + 5 * (vehicles - 1)


@compiled
def params_at(group: int, vehicles: int) -> int:
    """First column of a group of parameters: 0 braking, 1 driving, 2 latency, 3 mass, 4 speed limit.

    Where news comes link by link: 5 own latency, 6 news.
    """
    return 1 + group * vehicles


@compiled
def vehicles_in(state: Floats) -> int:
    """Number of vehicles N of these rows of state."""
    return int((state.shape[1] + 4) // 8)


class Packed(NamedTuple):
    """Worlds by rows."""

    state: Floats  # [n, S]
    params: Floats  # [n, 1 + 5 N], [n, 1 + 6 N + N * N] or, with M columns of messages, [n, 1 + 6 N + N * N + M]


def pack(worlds: Worlds) -> Packed:
    """Worlds by rows, with no harm so far; with columns of the obstacle, and of news by link, if any world has such."""
    n, N = worlds.speeds_mps.shape
    state = np.zeros((n, state_width(N)))
    state[:, TIME] = worlds.time_s
    state[:, speed_at(N) : command_at(N)] = worlds.speeds_mps
    state[:, command_at(N) : previous_at(N)] = worlds.command_mps2
    state[:, gap_at(N) : gap_at(N) + N - 1] = worlds.gaps_m
    state[:, gap_at(N) + N - 1 : harm_at(N)] = worlds.pair_hit
    v = worlds.vehicles
    plain = is_known_at_once(v) and worlds.messages.shape[1] == 0
    params = np.concatenate(
        [
            v.restitution[:, np.newaxis],
            v.braking_capacity_mps2,
            v.driving_capacity_mps2,
            v.latency_s,
            v.mass_t,
            v.speed_limit_mps,
            *(() if plain else (v.own_latency_s, v.known_from_s.reshape(n, N * N), worlds.messages)),
        ],
        axis=1,
    )
    if obstacle_ahead(worlds).any():
        none = np.zeros((n, OBSTACLE_WIDTH - 2))
        state = np.concatenate([state, np.column_stack([worlds.obstacle_gap_m, worlds.obstacle_hit]), none], axis=1)
    return Packed(state, params)


def has_obstacle(state: Floats, vehicles: int) -> bool:
    """Whether these rows have columns of an obstacle."""
    return bool(state.shape[1] > state_width(vehicles))


def with_obstacle_columns(state: Floats, vehicles: int) -> Floats:
    """The rows with columns of an obstacle; where there were none, they say that there is none."""
    if has_obstacle(state, vehicles):
        return state
    return np.concatenate([state, np.full((len(state), 1), np.inf), np.zeros((len(state), OBSTACLE_WIDTH - 1))], axis=1)


@compiled
def has_news(params: Floats, vehicles: int) -> bool:
    """Whether these rows have columns of news by link."""
    return bool(params.shape[1] > params_at(5, vehicles))


def with_news_columns(params: Floats, vehicles: int) -> Floats:
    """The rows with columns of news by link; where there were none, all news comes at the own latency."""
    if has_news(params, vehicles):
        return params
    latency = params[:, params_at(2, vehicles) : params_at(3, vehicles)]
    return np.concatenate([params, latency, latency.repeat(vehicles, axis=1)], axis=1)


@compiled
def messages_at(vehicles: int) -> int:
    """First of the parameters' columns of periodic messages."""
    return params_at(6, vehicles) + vehicles * vehicles


def has_messages(state: Floats, params: Floats) -> bool:
    """Whether these rows have columns of periodic messages. Not compiled: a call of a kernel costs more."""
    vehicles = (state.shape[1] + 4) // 8
    return bool(params.shape[1] > 1 + 6 * vehicles + vehicles * vehicles)


def own_latency_and_news(params: Floats, vehicles: int) -> tuple[Floats, Floats]:
    """``own_latency_s`` [n, N] and ``known_from_s`` [n, N, N] of these rows' ``Vehicles``, in their own memory."""
    if not has_news(params, vehicles):
        latency = params[:, params_at(2, vehicles) : params_at(3, vehicles)].copy()
        return latency, known_at_once(latency)
    own, news, end = params_at(5, vehicles), params_at(6, vehicles), messages_at(vehicles)
    return params[:, own:news].copy(), params[:, news:end].copy().reshape(-1, vehicles, vehicles)


def unpack(packed: Packed, vehicles: Vehicles | None = None) -> Worlds:
    """The worlds of these rows, in their own memory but for ``vehicles``, if they are given as they were unpacked."""
    state, params = packed
    N = vehicles_in(state)
    gaps, n = gap_at(N), len(state)
    far = not has_obstacle(state, N)
    return Worlds(
        _vehicles(params, N) if vehicles is None else vehicles,
        state[:, gaps : gaps + N - 1].copy(),
        state[:, speed_at(N) : command_at(N)].copy(),
        state[:, TIME].copy(),
        state[:, gaps + N - 1 : harm_at(N)] == 1.0,
        state[:, command_at(N) : previous_at(N)].copy(),
        np.full(n, np.inf) if far else state[:, state_width(N)].copy(),
        np.zeros(n, np.bool_) if far else state[:, state_width(N) + 1] == 1.0,
        params[:, messages_at(N) :].copy(),
    )


def _vehicles(params: Floats, vehicles: int) -> Vehicles:
    columns = (params[:, params_at(g, vehicles) : params_at(g + 1, vehicles)].copy() for g in range(5))
    braking, driving, latency, mass, limit = columns
    restitution = params[:, RESTITUTION].copy()
    if not has_news(params, vehicles):
        return vehicles_at_once(braking, driving, latency, mass, limit, restitution)
    own, news = own_latency_and_news(params, vehicles)
    return Vehicles(braking, driving, latency, mass, limit, restitution, own, news)


def ledger_columns(state: Floats, vehicles: int) -> tuple[Floats, Floats, Ints]:
    """First-impact harm, total harm and impacts of each pair since the episode began, [n, P] each."""
    pairs, first = vehicles - 1, harm_at(vehicles)
    groups = [state[:, first + g * pairs : first + (g + 1) * pairs].copy() for g in range(3)]
    return groups[0], groups[1], groups[2].astype(np.int64)


def obstacle_ledger_columns(state: Floats, vehicles: int) -> tuple[Floats, Floats, Ints]:
    """The same of the impacts with the obstacle, [n] each."""
    if not has_obstacle(state, vehicles):
        return no_obstacle_harm(len(state))
    first, total, count = (state[:, state_width(vehicles) + g].copy() for g in (2, 3, 4))
    return first, total, count.astype(np.int64)


NO_ROWS = np.empty((0, ROW_WIDTH))  # for kernels that keep no list of impacts
