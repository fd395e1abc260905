"""Periodic messages: what has been told to whom, how old it is, and where it lets a vehicle think the others are.

A vehicle samples its state at every decision moment, back to the alert. A message carries its sender's newest sample.
On each link one is sent every period, and the channel of the link is good or bad (Gilbert-Elliott): after the first
message that arrived it turns bad with probability p and good again with r, per message; one that is sent while it is
bad is lost. Chance is a pure function of the world's key, the link and the number of the message, whatever the batch
and the step. A neighbour in sight is measured: what is known of it is the present.

Columns, for N vehicles, behind the news in the parameters (``physics.batch.Columns``); they are the memory of the
channel and change as it speaks. The period is 0 in a world without periodic messages: there the present is known.

head    period (s), delay from sending to use (s), p, r, key (a whole number below 2^53), samples taken, place of the
        obstacle ahead (m; infinite: there is none)
place   N, where each vehicle is now (m; 0 is the front of Vehicle 1 at the alert, lengths not counted)
links   N * N times LINK columns, receiver by receiver
ring    the newest samples: RING_HEAD + 3 N columns each: time, whether Vehicle 1 has hit the obstacle, and the places,
        speeds and commands in force of all vehicles
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics.columns import Columns, columns
from ethbrake_marl.physics.episode import onset_s
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import command_acts
from ethbrake_marl.physics.pieces import force_at, force_now
from ethbrake_marl.physics.rows import FLAG, LISTED, ROW, place_forces, place_obstacle, rows_for
from ethbrake_marl.physics.segment import advance_table
from ethbrake_marl.physics.state import Bools, Floats, Worlds


class _Channel(NamedTuple):
    """The head: one entry for all links of a world."""

    PERIOD: int = 0
    DELAY: int = 1
    LOSS_BEGINS: int = 2
    LOSS_ENDS: int = 3
    KEY: int = 4
    TAKEN: int = 5
    OBSTACLE_PLACE: int = 6
    WIDTH: int = 7


CHANNEL = _Channel()


class _Link(NamedTuple):
    """Entries of a link, from the vehicle that sends to the one that hears it."""

    NEXT_SENT: int = 0  # when its next message is sent that is not dealt with (s); infinite: it carries none
    NUMBER: int = 1  # of that message, counted from the first one that arrives, which is 0
    BAD: int = 2  # 1 while the channel is bad
    SEEN_FROM: int = 3  # from when on the receiver measures the sender (s); infinite: never
    TOLD_S: int = 4  # when the newest state that arrived was sampled (s); below 0: none has
    TOLD_PLACE: int = 5
    TOLD_SPEED: int = 6
    TOLD_COMMAND: int = 7
    TOLD_HIT: int = 8  # whether Vehicle 1 had hit the obstacle by then
    WIDTH: int = 9


LINK = _Link()

RING_HEAD = 2

POST_M = 1e6  # so far ahead of Vehicle 1 an obstacle is out of reach; it makes the way of Vehicle 1 the change of a gap

_ON_GRID = 1e-9


@compiled
def place_at(vehicles: int) -> int:
    """First column of the places, counted from the head."""
    return CHANNEL.WIDTH


@compiled
def link_at(receiver: int, sender: int, vehicles: int) -> int:
    """First column of a link, counted from the head."""
    return CHANNEL.WIDTH + vehicles + LINK.WIDTH * (receiver * vehicles + sender)


@compiled
def ring_at(vehicles: int) -> int:
    """First column of the ring, counted from the head."""
    return CHANNEL.WIDTH + vehicles + LINK.WIDTH * vehicles * vehicles


class Told(NamedTuple):
    """The newest state that a vehicle was told of each other one, [n, N] each; views of the columns."""

    at_s: Floats  # when it was sampled; below 0: never
    place_m: Floats
    speed_mps: Floats
    command_mps2: Floats
    obstacle_hit: Floats  # 1 where Vehicle 1 had hit the obstacle by then
    own_place_m: Floats  # [n] where the vehicle is
    obstacle_place_m: Floats  # [n] where the obstacle ahead is


class Messages(NamedTuple):
    """What periodic messages have told whom, in n worlds."""

    columns: Floats  # [n, M]; M is 0 without periodic messages
    vehicles: int

    @classmethod
    def of(cls, worlds: Worlds) -> Messages:
        """Those of these worlds."""
        return cls(worlds.messages, worlds.N)

    @staticmethod
    def ring_length(delay_s: float, time_step_s: float) -> int:
        """Samples that a message may still carry when it arrives: those of its delay, and one at each end."""
        return math.ceil(delay_s / time_step_s - _ON_GRID) + 3

    @classmethod
    def silent(
        cls, heard_s: Floats, seen_s: Floats, key: Floats, samples: int, *, period_s: float, delay_s: float,
        loss_begins: float, loss_ends: float,
    ) -> Messages:  # fmt: skip
        """The columns before any message is sent.

        Args:
            heard_s: when the first message of vehicle j is of use to vehicle i, [n, N, N]; infinite: never.
            seen_s: from when on i measures j, [n, N, N]; infinite: never.
            key: [n], a whole number below 2^53, by which later messages are lost or not.
            samples: in the ring, see ``ring_length``.
            period_s: between two messages of a link.
            delay_s: from sending a message to its use.
            loss_begins: probability that a good channel turns bad, per message.
            loss_ends: probability that a bad one turns good again.

        """
        n, N = heard_s.shape[:2]
        silent = cls(np.zeros((n, ring_at(N) + samples * (RING_HEAD + 3 * N))), N)
        silent.columns[:, : CHANNEL.KEY] = period_s, delay_s, loss_begins, loss_ends
        silent.columns[:, CHANNEL.KEY] = key
        links, itself = silent.links, np.eye(N, dtype=np.bool_)
        links[..., LINK.NEXT_SENT] = np.where(itself, np.inf, heard_s - delay_s)
        links[..., LINK.SEEN_FROM] = np.where(itself, np.inf, seen_s)
        links[..., LINK.TOLD_S] = -1.0
        return silent

    @property
    def links(self) -> Floats:
        """The columns of every link, [n, N, N, LINK]: a view."""
        N = self.vehicles
        return self.columns[:, link_at(0, 0, N) : ring_at(N)].reshape(-1, N, N, LINK.WIDTH)

    @property
    def periodic(self) -> Bools:
        """In which worlds messages go on after the first one, so that what is known grows old, [n]."""
        return np.asarray((self.columns[:, CHANNEL.PERIOD : CHANNEL.PERIOD + 1] > 0.0).any(axis=1))

    def newest_told(self, vehicle: int) -> Told:
        """What ``vehicle`` was last told, in worlds with columns of messages."""
        own, obstacle = self.columns[:, place_at(self.vehicles) + vehicle], self.columns[:, CHANNEL.OBSTACLE_PLACE]
        told = self.links[:, vehicle]
        at_s, place, speed, command, hit = (told[..., entry] for entry in range(LINK.TOLD_S, LINK.WIDTH))
        return Told(at_s, place, speed, command, hit, own, obstacle)

    def age_s(self, time_s: Floats) -> Floats:
        """How old what vehicle i was last told of vehicle j is at ``time_s`` [n], [n, N, N] s: since it was sampled.

        0 without periodic messages, where the present is known; infinite where nothing has been told yet. Whether i may
        act on it is another question (``Vehicles.known_from_s``).
        """
        age, periodic = np.zeros((len(time_s), self.vehicles, self.vehicles)), self.periodic
        if periodic.any():
            told_s = self.links[..., LINK.TOLD_S]
            age[periodic] = np.where(told_s >= 0.0, time_s[:, np.newaxis, np.newaxis] - told_s, np.inf)[periodic]
            age[:, np.arange(self.vehicles), np.arange(self.vehicles)] = 0.0
        return age


@compiled
def chance(key: float, link: int, number: float) -> float:
    """A number in [0, 1) of message ``number`` of a link in the world of this key: 53 bits of a SplitMix64 hash."""
    z = np.uint64(key) ^ (np.uint64(link + 1) * np.uint64(0x9E3779B97F4A7C15))
    z ^= np.uint64(number + 1.0) * np.uint64(0xD1342543DE82EF95)
    for _ in range(2):
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return float(z >> np.uint64(11)) * 2.0**-53


@compiled
def hear_rows(
    moving: Floats, params: Floats, wanted: Floats, until_s: Floats, decision_s: Floats, time_step_s: float,
    pieces: Floats,
) -> None:  # fmt: skip
    """Take the messages' columns of every world from its time in ``moving`` to ``until_s`` [n], in place.

    ``moving`` [n, S] are the worlds as they were, and go along; ``wanted`` [n, N] is what the vehicles want meanwhile;
    ``pieces`` [N, 2 K] as in ``Vehicles``.
    Samples are taken every ``time_step_s``, counted back from the next decision at ``decision_s`` [n]; who stops before
    it measures the present, and that sample is not kept. A world that cannot be advanced hears nothing.
    """
    column = columns(moving)
    N, head = column.vehicles, column.messages
    table = np.zeros((rows_for(pieces.shape[1]), N + 1))
    no_rows = np.empty((0, LISTED.WIDTH))
    for k in range(moving.shape[0]):
        if params[k, head + CHANNEL.PERIOD] == 0.0:
            continue
        told = params[k, head:]
        if told[CHANNEL.TAKEN] == 0.0:
            _start(moving[k], params[k], column, wanted[k])
        while moving[k, column.time] < until_s[k]:
            left = math.ceil((decision_s[k] - moving[k, column.time]) / time_step_s - 1e-6) - 1.0
            end = decision_s[k] - max(left, 0.0) * time_step_s
            stops = end > until_s[k]
            if stops:
                end = until_s[k]
            if not _move(moving[k], params[k], column, wanted[k], end, pieces, table, no_rows):
                break
            _sample(moving[k], told, column)
            _receive(moving[k, column.time], told, N)
            if stops:
                told[CHANNEL.TAKEN] -= 1.0


@compiled
def _start(state: Floats, params: Floats, column: Columns, wanted: Floats) -> None:
    """Places and the first sample, at the alert."""
    N, obstacle, gap, force = column.vehicles, column.obstacle, column.gap, column.command
    told, place = params[column.messages :], place_at(N)
    told[place] = 0.0
    told[CHANNEL.OBSTACLE_PLACE] = state[obstacle] if state.shape[0] > obstacle else math.inf
    for p in range(N - 1):
        told[place + p + 1] = told[place + p] - state[gap + p]
    for i in range(N):
        acts = command_acts(params[column.latency + i], state[column.time])
        state[force + i] = force_now(
            state[force + i], wanted[i] if acts else 0.0, params[column.brake_rate + i], params[column.release_rate + i]
        )
    _sample(state, told, column)
    _receive(state[column.time], told, N)


@compiled
def _move(
    state: Floats, params: Floats, column: Columns, wanted: Floats, end: float, pieces: Floats, table: Floats,
    no_rows: Floats,
) -> bool:  # fmt: skip
    """One world moved to ``end``, its places included; False, and nothing moved, where the kernel cannot."""
    N, time = column.vehicles, state[column.time]
    speed, command, gap, obstacle = column.speed, column.command, column.gap, column.obstacle
    with_obstacle = state.shape[0] > obstacle and state[obstacle] < math.inf
    ahead = state[obstacle] if with_obstacle else POST_M
    place_obstacle(table, ahead, state[obstacle + 1] if with_obstacle else 0.0)
    latency = column.latency
    for i in range(N):
        table[ROW.SPEED, i + 1] = state[speed + i]
        table[ROW.COMMAND, i + 1] = wanted[i]
        table[ROW.MASS, i + 1] = params[column.mass + i]
        table[ROW.LIMIT, i + 1] = params[column.limit + i]
        table[ROW.ONSET, i + 1] = onset_s(params[latency + i], time)
    place_forces(
        table, state[command : command + N], params[column.brake_rate : column.release_rate],
        params[column.release_rate : column.own_latency], pieces,
    )  # fmt: skip
    for p in range(N - 1):
        table[ROW.GAP, p + 1] = state[gap + p]
        table[ROW.HIT, p + 1] = state[gap + N - 1 + p]
    if advance_table(table, params[column.restitution], end - time, time, 0, no_rows, 0)[1] != FLAG.DONE:
        return False
    place = column.messages + place_at(N)
    params[place] += ahead - table[ROW.GAP, 0]
    state[column.time] = end
    for i in range(N):
        state[speed + i] = table[ROW.SPEED, i + 1]
        state[command + i] = force_at(table, i + 1, wanted[i], params[latency + i], end)
    for p in range(N - 1):
        state[gap + p] = table[ROW.GAP, p + 1]
        state[gap + N - 1 + p] = table[ROW.HIT, p + 1]
        params[place + p + 1] = params[place + p] - table[ROW.GAP, p + 1]
    if with_obstacle:
        state[obstacle] = table[ROW.GAP, 0]
        state[obstacle + 1] = table[ROW.HIT, 0]
    return True


@compiled
def _sample(state: Floats, told: Floats, column: Columns) -> None:
    """Every vehicle takes a sample of its state, over the oldest one."""
    N, obstacle = column.vehicles, column.obstacle
    width, first = RING_HEAD + 3 * N, ring_at(N)
    at = first + width * (int(told[CHANNEL.TAKEN]) % ((told.shape[0] - first) // width))
    told[at] = state[column.time]
    told[at + 1] = state[obstacle + 1] if state.shape[0] > obstacle else 0.0
    for i in range(N):
        told[at + RING_HEAD + i] = told[place_at(N) + i]
        told[at + RING_HEAD + N + i] = state[column.speed + i]
        told[at + RING_HEAD + 2 * N + i] = state[column.command + i]
    told[CHANNEL.TAKEN] += 1.0


@compiled
def _receive(time: float, told: Floats, N: int) -> None:
    """Deal with every message that is of use by now, and measure who is in sight."""
    for i in range(N):
        for j in range(N):
            link = link_at(i, j, N)
            while told[link + LINK.NEXT_SENT] + told[CHANNEL.DELAY] <= time + _ON_GRID:
                u, bad = chance(told[CHANNEL.KEY], i * N + j, told[link + LINK.NUMBER]), told[link + LINK.BAD] == 1.0
                if told[link + LINK.NUMBER] > 0.0:  # the first one did arrive
                    bad = u >= told[CHANNEL.LOSS_ENDS] if bad else u < told[CHANNEL.LOSS_BEGINS]
                    told[link + LINK.BAD] = 1.0 if bad else 0.0
                if not bad:
                    _take(told, link, j, told[link + LINK.NEXT_SENT], N)
                told[link + LINK.NUMBER] += 1.0
                told[link + LINK.NEXT_SENT] += told[CHANNEL.PERIOD]
            if told[link + LINK.SEEN_FROM] <= time:
                _take(told, link, j, time, N)


@compiled
def _take(told: Floats, link: int, sender: int, sent_s: float, N: int) -> None:
    """A message that was sent at ``sent_s`` arrives: the sender's newest sample of then."""
    width, first = RING_HEAD + 3 * N, ring_at(N)
    length = (told.shape[0] - first) // width
    taken = int(told[CHANNEL.TAKEN])
    for back in range(min(length, taken)):
        at = first + width * ((taken - 1 - back) % length)
        if told[at] <= sent_s + _ON_GRID:
            if told[at] >= told[link + LINK.TOLD_S]:
                told[link + LINK.TOLD_S] = told[at]
                told[link + LINK.TOLD_HIT] = told[at + 1]
                told[link + LINK.TOLD_PLACE] = told[at + RING_HEAD + sender]
                told[link + LINK.TOLD_SPEED] = told[at + RING_HEAD + N + sender]
                told[link + LINK.TOLD_COMMAND] = told[at + RING_HEAD + 2 * N + sender]
            return
