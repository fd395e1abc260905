"""Worlds packed into two arrays, state and parameters, one row per world: the layout that the engine uses.

Compiled functions receive, copy and change two arrays much faster than a dozen arrays.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Vehicles, Worlds


class Columns(NamedTuple):
    """First column of each group of quantities in the rows of ``Packed``, for N vehicles and P = N - 1 pairs.

    A group ends where the next group begins. The group *news by link* contains the times from which each vehicle may
    act on information about each other vehicle. If no world needs these times, the group does not exist, and every
    vehicle knows everything once its own latency has elapsed. The last columns belong to periodic messages
    (``physics.messages``); their values change when messages arrive.
    """

    vehicles: int  # the number N itself, not a column
    # columns of the state
    time: int  # 1 column: time since Vehicle 1 began to brake (s)
    speed: int  # N columns (m/s)
    command: int  # N columns, acceleration in force (m/s2)
    previous: int  # N columns, acceleration in force before the last segment (m/s2)
    gap: int  # P columns, bumper to bumper (m)
    hit: int  # P columns, 1 once the pair has had an impact
    harm: int  # 3 P columns since the start of the episode: first-impact harm, total harm, number of impacts
    obstacle: int  # 5 columns: gap (m; infinite: none), hit flag, both harms, impacts; if absent, the row's width
    # columns of the parameters
    restitution: int  # 1 column, coefficient of restitution
    braking: int  # N columns, braking capacity (m/s2)
    driving: int  # N columns, driving capacity (m/s2)
    latency: int  # N columns, time before which commands have no effect (s)
    mass: int  # N columns (t)
    limit: int  # N columns, speed up to which a vehicle drives (m/s)
    brake_rate: int  # N columns, rate at which the acceleration in force falls (m/s3)
    release_rate: int  # N columns, rate at which the acceleration in force rises (m/s3)
    harm_weight: int  # N columns, weight of the vehicle's harm in the objective ``preference``
    own_latency: int  # N columns, part of the latency without the channel (s); if absent, the row's width
    news: int  # N * N columns, time from which vehicle i acts on news of vehicle j (s)
    messages: int  # M columns, ``physics.messages``; if absent, the row's width


OBSTACLE_WIDTH = 5


def _columns_of(vehicles: int) -> Columns:
    N, P = vehicles, vehicles - 1
    gap, news = 1 + 3 * N, 1 + 9 * N
    return Columns(
        N, 0, 1, 1 + N, 1 + 2 * N, gap, gap + P, gap + 2 * P, gap + 5 * P,
        0, 1, 1 + N, 1 + 2 * N, 1 + 3 * N, 1 + 4 * N, 1 + 5 * N, 1 + 6 * N, 1 + 7 * N, 1 + 8 * N, news,
        news + N * N,
    )  # fmt: skip


_known_columns = lru_cache(maxsize=64)(_columns_of)

_compiled_columns = compiled(_columns_of)


@compiled
def columns(state: Floats) -> Columns:
    """Return ``Columns`` for worlds with the packed ``state`` [n, S]."""
    return _compiled_columns((state.shape[1] + 4) // 8)


class Packed(NamedTuple):
    """State and parameters of n worlds, packed into two arrays with one row per world."""

    state: Floats  # [n, S] what changes during an episode; columns ``time`` to ``obstacle`` of ``Columns``
    # parameters of the vehicles and state of the messages; columns ``restitution`` to ``messages`` of ``Columns``:
    # [n, 1 + 8 N]; with news by link [n, 1 + 9 N + N * N]; with M columns of messages [n, 1 + 9 N + N * N + M]
    params: Floats

    @classmethod
    def of(cls, worlds: Worlds) -> Packed:
        """Pack ``worlds`` as at the start of an episode, with harm 0.

        The columns of an obstacle and *news by link* exist only if at least one world needs them.
        """
        v, (n, N) = worlds.vehicles, worlds.speeds_mps.shape
        none = np.zeros((n, 3 * (N - 1)))
        state = [
            worlds.time_s[:, np.newaxis], worlds.speeds_mps, worlds.command_mps2, np.zeros((n, N)), worlds.gaps_m,
            worlds.pair_hit, none,
        ]  # fmt: skip
        params = [
            v.restitution[:, np.newaxis], v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t,
            v.speed_limit_mps, v.brake_rate_mps3, v.release_rate_mps3, v.harm_weight,
        ]  # fmt: skip
        if not v.is_known_at_once or worlds.messages.shape[1] > 0:
            params += [v.own_latency_s, v.known_from_s.reshape(n, N * N), worlds.messages]
        if worlds.obstacle_ahead.any():
            state += [worlds.obstacle_gap_m[:, np.newaxis], worlds.obstacle_hit[:, np.newaxis], none[:, :3]]
        return cls(np.concatenate(state, axis=1), np.concatenate(params, axis=1))

    @property
    def column(self) -> Columns:
        """First column of each group of quantities."""
        return _known_columns((self.state.shape[1] + 4) // 8)

    @property
    def has_obstacle(self) -> bool:
        """Whether the rows have columns for an obstacle."""
        return bool(self.state.shape[1] > self.column.obstacle)

    @property
    def has_news(self) -> bool:
        """Whether the rows have the columns *news by link*."""
        return bool(self.params.shape[1] > self.column.own_latency)

    @property
    def has_messages(self) -> bool:
        """Whether the rows have columns for periodic messages."""
        return bool(self.params.shape[1] > self.column.messages)

    @property
    def builds_up(self) -> bool:
        """Whether the brakes of at least one vehicle build up at a finite rate."""
        column = self.column
        return bool(np.isfinite(self.params[:, column.brake_rate : column.harm_weight]).any())

    def widened(self, obstacle: bool, news: bool) -> Packed:
        """Return these worlds, with missing columns of an obstacle and of *news by link* added.

        ``obstacle`` and ``news`` say which columns to add. Added columns contain the values of a world without an
        obstacle, in which each vehicle knows everything once its own latency has elapsed.
        """
        (state, params), column = self, self.column
        if obstacle and not self.has_obstacle:
            none = (np.full((len(state), 1), np.inf), np.zeros((len(state), OBSTACLE_WIDTH - 1)))
            state = np.concatenate([state, *none], axis=1)
        if news and not self.has_news:
            latency = params[:, column.latency : column.mass]
            params = np.concatenate([params, latency, latency.repeat(column.vehicles, axis=1)], axis=1)
        return Packed(state, params)

    def worlds(self, vehicles: Vehicles | None = None) -> Worlds:
        """Unpack the two arrays into ``Worlds`` with new arrays.

        ``vehicles`` are the parameters of the result; None: unpack them from the arrays.
        """
        (state, params), column, far = self, self.column, not self.has_obstacle
        return Worlds(
            self._vehicles() if vehicles is None else vehicles,
            state[:, column.gap : column.hit].copy(),
            state[:, column.speed : column.command].copy(),
            state[:, column.time].copy(),
            state[:, column.hit : column.harm] == 1.0,
            state[:, column.command : column.previous].copy(),
            np.full(len(state), np.inf) if far else state[:, column.obstacle].copy(),
            np.zeros(len(state), np.bool_) if far else state[:, column.obstacle + 1] == 1.0,
            params[:, column.messages :].copy(),
            np.zeros((len(state), 0)),
        )

    def _vehicles(self) -> Vehicles:
        params, column = self.params, self.column
        ends = (
            column.braking, column.driving, column.latency, column.mass, column.limit, column.brake_rate,
            column.release_rate, column.harm_weight, column.own_latency,
        )  # fmt: skip
        parts = [params[:, begin:end].copy() for begin, end in pairwise(ends)]
        braking, driving, latency, mass, limit, brake_rate, release_rate, weight = parts
        restitution, none = params[:, column.restitution].copy(), np.zeros((*latency.shape, 0))
        every = braking, driving, latency, mass, limit, restitution, brake_rate, release_rate, none, weight
        if not self.has_news:
            return Vehicles.at_once(*every)
        return Vehicles(*every, params[:, column.own_latency : column.news].copy(), self.known_from_s)

    @property
    def known_from_s(self) -> Floats:
        """Time from which vehicle i acts on news of vehicle j, [n, N, N] s, as a new array."""
        column = self.column
        if not self.has_news:
            return Vehicles.known_at_once(self.params[:, column.latency : column.mass].copy())
        return self.params[:, column.news : column.messages].copy().reshape(-1, column.vehicles, column.vehicles)

    def ledger(self) -> tuple[Floats, Floats, Ints, Floats, Floats, Ints]:
        """Return harm and number of impacts since the episode began: three arrays of the pairs, three of the obstacle.

        The arrays of the pairs, [n, P], are first-impact harm (m2/s2), total harm (m2/s2) and number of impacts. The
        arrays of the obstacle, [n], contain the same for the impacts of Vehicle 1 with the obstacle.
        """
        state, column, pairs = self.state, self.column, self.column.vehicles - 1
        first, total, count = (state[:, at : at + pairs].copy() for at in range(column.harm, column.obstacle, pairs))
        of_obstacle = Impacts.no_obstacle(len(state))
        if self.has_obstacle:
            harm, whole, hits = (state[:, column.obstacle + g].copy() for g in (2, 3, 4))
            of_obstacle = harm, whole, hits.astype(np.int64)
        return first, total, count.astype(np.int64), *of_obstacle
