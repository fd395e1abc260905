"""Worlds packed into rows, one row per world: the layout in which the engine keeps them.

Two arrays (state and parameters) are far cheaper to hand to a kernel, to copy and to replace row by row than a dozen.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.left_out import Impacts
from ethbrake_marl.physics.state import Floats, Ints, Vehicles, Worlds


class Columns(NamedTuple):
    """First column of each group of the rows of N vehicles and P = N - 1 pairs; it ends where the next one begins.

    News by link is there where some news comes so, else latencies are all own, and everything is known from them on.
    The columns of periodic messages (``physics.messages``) follow it, and change as messages come in.
    """

    vehicles: int  # N, no column
    # of the state
    time: int
    speed: int  # N (m/s)
    command: int  # N, in force (m/s2)
    previous: int  # N, in force before the last segment (m/s2)
    gap: int  # P (m)
    hit: int  # P
    harm: int  # since the episode began: first-impact harm P, total harm P, impacts P
    obstacle: int  # the width without an obstacle; else its gap (infinite: none), hit flag, both harms, impacts
    # of the parameters
    restitution: int
    braking: int  # N
    driving: int  # N
    latency: int  # N
    mass: int  # N
    limit: int  # N
    brake_rate: int  # N
    release_rate: int  # N
    own_latency: int  # the width without news by link; else N
    news: int  # N * N: from when on vehicle i acts on news of vehicle j
    messages: int  # the width without periodic messages


OBSTACLE_WIDTH = 5


def _columns_of(vehicles: int) -> Columns:
    N, P = vehicles, vehicles - 1
    gap, news = 1 + 3 * N, 1 + 8 * N
    return Columns(
        N, 0, 1, 1 + N, 1 + 2 * N, gap, gap + P, gap + 2 * P, gap + 5 * P,
        0, 1, 1 + N, 1 + 2 * N, 1 + 3 * N, 1 + 4 * N, 1 + 5 * N, 1 + 6 * N, 1 + 7 * N, news, news + N * N,
    )  # fmt: skip


_known_columns = lru_cache(maxsize=64)(_columns_of)

_compiled_columns = compiled(_columns_of)


@compiled
def columns(state: Floats) -> Columns:
    """The columns of these rows of state, [n, S], and of their parameters."""
    return _compiled_columns((state.shape[1] + 4) // 8)


class Packed(NamedTuple):
    """Worlds by rows."""

    state: Floats  # [n, S]
    params: Floats  # [n, 1 + 7 N], [n, 1 + 8 N + N * N] or, with M columns of messages, [n, 1 + 8 N + N * N + M]

    @classmethod
    def of(cls, worlds: Worlds) -> Packed:
        """Worlds with no harm so far; with columns of the obstacle, and of news by link, if any world has such."""
        v, (n, N) = worlds.vehicles, worlds.speeds_mps.shape
        none = np.zeros((n, 3 * (N - 1)))
        state = [
            worlds.time_s[:, np.newaxis], worlds.speeds_mps, worlds.command_mps2, np.zeros((n, N)), worlds.gaps_m,
            worlds.pair_hit, none,
        ]  # fmt: skip
        params = [
            v.restitution[:, np.newaxis], v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t,
            v.speed_limit_mps, v.brake_rate_mps3, v.release_rate_mps3,
        ]  # fmt: skip
        if not v.is_known_at_once or worlds.messages.shape[1] > 0:
            params += [v.own_latency_s, v.known_from_s.reshape(n, N * N), worlds.messages]
        if worlds.obstacle_ahead.any():
            state += [worlds.obstacle_gap_m[:, np.newaxis], worlds.obstacle_hit[:, np.newaxis], none[:, :3]]
        return cls(np.concatenate(state, axis=1), np.concatenate(params, axis=1))

    @property
    def column(self) -> Columns:
        """Where each group begins."""
        return _known_columns((self.state.shape[1] + 4) // 8)

    @property
    def has_obstacle(self) -> bool:
        """Whether the rows have columns of an obstacle."""
        return bool(self.state.shape[1] > self.column.obstacle)

    @property
    def has_news(self) -> bool:
        """Whether the rows have columns of news by link."""
        return bool(self.params.shape[1] > self.column.own_latency)

    @property
    def has_messages(self) -> bool:
        """Whether the rows have columns of periodic messages."""
        return bool(self.params.shape[1] > self.column.messages)

    @property
    def builds_up(self) -> bool:
        """Whether brakes of some world build up."""
        column = self.column
        return bool(np.isfinite(self.params[:, column.brake_rate : column.own_latency]).any())

    def widened(self, obstacle: bool, news: bool) -> Packed:
        """The rows with columns of an obstacle, and of news by link, where that is wanted.

        Where there were none, they say that there is no obstacle, and that all news comes at the own latency.
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
        """The worlds, in their own memory but for ``vehicles``, if they are given as they were unpacked."""
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
            column.release_rate, column.own_latency,
        )  # fmt: skip
        braking, driving, latency, mass, limit, *rates = (params[:, begin:end].copy() for begin, end in pairwise(ends))
        restitution = params[:, column.restitution].copy()
        if not self.has_news:
            return Vehicles.at_once(braking, driving, latency, mass, limit, restitution, *rates)
        own = params[:, column.own_latency : column.news].copy()
        brake_rate, release_rate = rates
        known = self.known_from_s
        none = np.zeros((*latency.shape, 0))
        return Vehicles(braking, driving, latency, mass, limit, restitution, brake_rate, release_rate, none, own, known)

    @property
    def known_from_s(self) -> Floats:
        """``Vehicles.known_from_s`` [n, N, N] of these rows, in its own memory."""
        column = self.column
        if not self.has_news:
            return Vehicles.known_at_once(self.params[:, column.latency : column.mass].copy())
        return self.params[:, column.news : column.messages].copy().reshape(-1, column.vehicles, column.vehicles)

    def ledger(self) -> tuple[Floats, Floats, Ints, Floats, Floats, Ints]:
        """Since the episode began: both harms and impacts of each pair, [n, P] each; of the obstacle, [n] each."""
        state, column, pairs = self.state, self.column, self.column.vehicles - 1
        first, total, count = (state[:, at : at + pairs].copy() for at in range(column.harm, column.obstacle, pairs))
        of_obstacle = Impacts.no_obstacle(len(state))
        if self.has_obstacle:
            harm, whole, hits = (state[:, column.obstacle + g].copy() for g in (2, 3, 4))
            of_obstacle = harm, whole, hits.astype(np.int64)
        return first, total, count.astype(np.int64), *of_obstacle
