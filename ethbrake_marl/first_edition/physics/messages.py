"""Periodic messages: the information that each vehicle has received about each other vehicle, and its age.

A vehicle samples its state at every decision, starting at the alert. A message contains the sender's newest sample. On
each link (from one vehicle to another) a message is sent once per period. The link's channel is either good or bad
(Gilbert-Elliott model). With each message after the first message that arrives, a good channel turns bad with
probability p, and a bad channel turns good with probability r. A message sent while the channel is bad is lost. The
random number that decides whether a message is lost depends only on the world's key (a seed), the link and the number
of the message. A vehicle measures a neighbour in sight, so it knows the neighbour's present state.

The state of the messages is stored in the following columns of a world's parameters, after the group *news by link*
(``physics.columns.Columns``). The columns change during an episode. If the period is 0, the world has no periodic
messages, and vehicles know the present state.

head    the columns of ``_Channel``: p, r and other settings, number of samples taken, place of the obstacle ahead
place   N, present place of each vehicle (m; 0 is the front of Vehicle 1 at the alert, vehicle lengths not counted)
links   N * N times the columns of ``_Link``, ordered by receiver, then sender
ring    the newest samples in a ring buffer, RING_HEAD + 3 N columns each: time, whether Vehicle 1 has hit the obstacle,
        and places, speeds and commands in force of all vehicles

A scenario can say what a message contains (``v2x: tells``). Worlds of such a scenario are marked by a flag in the
columns of the link from Vehicle 1 to itself. In these worlds, each sample also contains the *intents*: the commands
that the N vehicles chose at the last decision. If the flag is set, there are three more groups of columns between
*links* and *ring*, even without periodic messages:

contents    N * CONTENTS: 1 if messages of this vehicle contain this quantity (see ``PIECES``), else 0
intents     N, present intent of each vehicle (m/s2)
told        N * N, by receiver, then sender: intent in the newest message received (m/s2)

Arguments that several functions share:

- ``messages``: the message columns of one world; returned column numbers are counted from the first of them
- ``state`` [S], ``params``: one world in the layout of ``physics.columns``; ``column``: first column of each group
- ``wanted``: commands that the vehicles chose at the last decision, [N] m/s2
- ``pieces``: starts (s) and commands (m/s2) of braking profiles, [N, 2 K], as in ``Vehicles.pieces``, for all worlds
- ``vehicles``, ``N``: number of vehicles; ``vehicle``, ``receiver``, ``sender``: indices from 0
- ``time``, ``end`` and arguments whose names end in ``_s`` are in s
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.columns import Columns, columns
from ethbrake_marl.first_edition.physics.episode import onset_s
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import command_acts
from ethbrake_marl.first_edition.physics.pieces import force_at, force_now
from ethbrake_marl.first_edition.physics.rows import FLAG, LISTED, ROW, place_forces, place_obstacle, rows_for
from ethbrake_marl.first_edition.physics.segment import advance_table
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds

Piece = Literal["place", "speed", "acceleration", "braking_capacity", "latency", "mass", "intent"]

PIECES: tuple[Piece, ...] = get_args(Piece)  # what a message may contain

MEASURED = PIECES[:3]  # what sensors measure of a vehicle in sight

USUAL_PIECES = PIECES[:-1]  # what a message contains unless the scenario says otherwise

PLACE, SPEED, ACCELERATION, BRAKING_CAPACITY, LATENCY, MASS, INTENT = range(7)  # indices into PIECES

CONTENTS = len(PIECES)  # number of columns that say what messages of one vehicle contain


class _Channel(NamedTuple):
    """Column numbers of the group *head*, which all links of a world share."""

    PERIOD: int = 0  # time between two messages of a link (s); 0: the world has no periodic messages
    DELAY: int = 1  # time from sending a message to its use (s)
    LOSS_BEGINS: int = 2  # probability per message that a good channel turns bad
    LOSS_ENDS: int = 3  # probability per message that a bad channel turns good again
    KEY: int = 4  # seed of the message losses, a whole number below 2^53
    TAKEN: int = 5  # number of samples taken so far
    OBSTACLE_PLACE: int = 6  # place of the obstacle ahead (m); infinite: none
    WIDTH: int = 7  # number of columns of the head


CHANNEL = _Channel()

PLACES_AT = CHANNEL.WIDTH  # first column of the places of the vehicles (m along the road)


class _Link(NamedTuple):
    """Column numbers of a link from one sending vehicle to one receiving vehicle."""

    NEXT_SENT: int = 0  # when the next unprocessed message is sent (s); infinite: no messages on this link
    NUMBER: int = 1  # number of the next unprocessed message; 0 is the first message that arrives
    BAD: int = 2  # 1 while the channel is bad
    SEEN_FROM: int = 3  # time from which the receiver measures the sender (s); infinite: never
    TOLD_S: int = 4  # when the newest received state was sampled (s); below 0: nothing received
    TOLD_PLACE: int = 5  # place of the sender in that state (m)
    TOLD_SPEED: int = 6  # speed of the sender in that state (m/s)
    TOLD_COMMAND: int = 7  # acceleration in force of the sender in that state (m/s2)
    TOLD_HIT: int = 8  # 1 if Vehicle 1 had hit the obstacle at that time, else 0
    WIDTH: int = 9  # number of columns of a link


LINK = _Link()

RING_HEAD = 2

POST_M = 1e6  # gap to a dummy obstacle out of reach; the change of this gap is the distance that Vehicle 1 travels

_ON_GRID = 1e-9


@compiled
def link_at(receiver: int, sender: int, vehicles: int) -> int:
    """Return the first column of the link from ``sender`` to ``receiver``."""
    return CHANNEL.WIDTH + vehicles + LINK.WIDTH * (receiver * vehicles + sender)


@compiled
def contents_at(vehicles: int) -> int:
    """Return the first column of the group *contents*; without this group, of the ring buffer."""
    return CHANNEL.WIDTH + vehicles + LINK.WIDTH * vehicles * vehicles


@compiled
def intent_at(vehicles: int) -> int:
    """Return the first column of the group *intents*; the group *told* begins N columns later."""
    return contents_at(vehicles) + CONTENTS * vehicles


@compiled
def has_contents(messages: Floats, vehicles: int) -> bool:
    """Return whether the message columns of a world have the group *contents*."""
    return bool(messages.shape[0] > 0 and messages[link_at(0, 0, vehicles) + LINK.NUMBER] == 1.0)


@compiled
def ring_at(messages: Floats, vehicles: int) -> int:
    """Return the first column of the ring buffer."""
    contents = vehicles * (CONTENTS + 1 + vehicles) if has_contents(messages, vehicles) else 0
    return contents_at(vehicles) + contents


@compiled
def sample_width(messages: Floats, vehicles: int) -> int:
    """Return the number of columns that one sample of all vehicles has in the ring buffer."""
    return RING_HEAD + (4 if has_contents(messages, vehicles) else 3) * vehicles


@compiled
def knows_piece(messages: Floats, vehicles: int, receiver: int, sender: int, piece: int, time: float) -> bool:
    """Return whether, at ``time``, ``receiver`` knows the quantity ``PIECES[piece]`` of ``sender``.

    The function assumes that the sender's first message has arrived by ``time``, or that the sender is in sight.
    ``messages`` may be empty, for a world without message columns. The receiver knows the intent only by a message. It
    knows every other quantity if the sender's messages contain it. Once the sender is in sight, the receiver also knows
    the sender's place, speed and acceleration, because it measures them.
    """
    if not has_contents(messages, vehicles):
        return piece != INTENT
    link = link_at(receiver, sender, vehicles)
    if piece <= ACCELERATION and messages[link + LINK.SEEN_FROM] <= time:
        return True
    heard = messages[link + LINK.NUMBER] > 0.0 or messages[link + LINK.NEXT_SENT] + messages[CHANNEL.DELAY] <= time
    said: bool = messages[contents_at(vehicles) + CONTENTS * sender + piece] == 1.0
    return said and (piece != INTENT or heard)


@compiled
def knows_line(messages: Floats, vehicles: int, receiver: int, sender: int, time: float) -> bool:
    """Return whether ``receiver`` knows all data of ``sender`` that are needed to predict the sender's motion."""
    known = True
    for piece in range(INTENT):
        known = known and knows_piece(messages, vehicles, receiver, sender, piece, time)
    return known


@compiled
def _known_pieces(messages: Floats, time: Floats, vehicles: int, receiver: int, known: NDArray[np.bool_]) -> None:
    for k in range(known.shape[0]):
        for j in range(vehicles):
            for piece in range(CONTENTS):
                known[k, j, piece] = knows_piece(messages[k], vehicles, receiver, j, piece, time[k])


class Told(NamedTuple):
    """For one receiving vehicle: the newest state of every vehicle, received by message or by sight.

    Arrays are [n, N] unless stated otherwise, with column j for vehicle j. The arrays are views of the message columns.
    """

    at_s: Floats  # time at which the state was sampled (s); below 0: nothing received
    place_m: Floats  # front of vehicle j in that state; 0 is the front of Vehicle 1 at the alert (m)
    speed_mps: Floats  # speed of vehicle j in that state (m/s)
    command_mps2: Floats  # acceleration in force of vehicle j in that state (m/s2)
    obstacle_hit: Floats  # 1 if Vehicle 1 had hit the obstacle at that time
    own_place_m: Floats  # [n] present place of the receiving vehicle (m)
    obstacle_place_m: Floats  # [n] place of the obstacle ahead (m); infinite: none


class Messages(NamedTuple):
    """Periodic messages of n worlds: what each vehicle has received from the others, and the channel's settings."""

    columns: Floats  # [n, M] the columns that the module's docstring describes; M may be 0
    vehicles: int  # number N of vehicles in a line

    @classmethod
    def of(cls, worlds: Worlds) -> Messages:
        """Return the messages of ``worlds``, with the array ``worlds.messages`` itself and not a copy."""
        return cls(worlds.messages, worlds.N)

    @staticmethod
    def ring_length(delay_s: float, time_step_s: float) -> int:
        """Return how many samples the ring buffer must store: the samples of one message delay, and three more.

        ``delay_s`` is the time from sending a message to its use, ``time_step_s`` the time between two samples.
        """
        return math.ceil(delay_s / time_step_s - _ON_GRID) + 3

    @classmethod
    def silent(
        cls, heard_s: Floats, seen_s: Floats, key: Floats, samples: int, *, period_s: float, delay_s: float,
        loss_begins: float, loss_ends: float, contents: Bools | None = None,
    ) -> Messages:  # fmt: skip
        """Return the messages of n worlds at the alert (time 0), before any message is sent.

        Args:
            heard_s: time from which vehicle i can use the first message of vehicle j, [n, N, N] s; infinite: never.
            seen_s: time from which vehicle i measures vehicle j, [n, N, N] s; infinite: never.
            key: seed of the message losses in each world, [n], whole numbers below 2^53.
            samples: number of samples that the ring buffer stores, see ``ring_length``.
            period_s: time between two messages of a link, s.
            delay_s: time from sending a message to its use, s.
            loss_begins: probability per message that a good channel turns bad.
            loss_ends: probability per message that a bad channel turns good again.
            contents: whether messages of vehicle j contain each quantity of ``PIECES``, [N, CONTENTS]; None: all
                quantities except the intent.

        """
        n, N = heard_s.shape[:2]
        links_end, marked = contents_at(N), np.zeros(contents_at(N))
        marked[link_at(0, 0, N) + LINK.NUMBER] = contents is not None
        silent = cls(np.zeros((n, ring_at(marked, N) + samples * sample_width(marked, N))), N)
        silent.columns[:, :links_end] = marked
        if contents is not None:
            silent.columns[:, links_end : intent_at(N)] = contents.ravel()
        silent.columns[:, : CHANNEL.KEY] = period_s, delay_s, loss_begins, loss_ends
        silent.columns[:, CHANNEL.KEY] = key
        links, itself = silent.links, np.eye(N, dtype=np.bool_)
        links[..., LINK.NEXT_SENT] = np.where(itself, np.inf, heard_s - delay_s)
        links[..., LINK.SEEN_FROM] = np.where(itself, np.inf, seen_s)
        links[..., LINK.TOLD_S] = -1.0
        return silent

    @property
    def links(self) -> Floats:
        """View of the columns of all links, [n, N, N, LINK.WIDTH]: by world, receiver, sender, column of ``LINK``."""
        N = self.vehicles
        return self.columns[:, link_at(0, 0, N) : contents_at(N)].reshape(-1, N, N, LINK.WIDTH)

    @property
    def periodic(self) -> Bools:
        """For each world, whether its vehicles send periodic messages, so that received information can be old, [n]."""
        return np.asarray((self.columns[:, CHANNEL.PERIOD : CHANNEL.PERIOD + 1] > 0.0).any(axis=1))

    @property
    def contents(self) -> Bools:
        """For each vehicle, whether its messages contain each quantity of ``PIECES``, [n, N, CONTENTS]."""
        usual = np.array([piece in USUAL_PIECES for piece in PIECES])
        n, N = len(self.columns), self.vehicles
        contents = np.broadcast_to(usual, (n, N, CONTENTS)).copy()
        if self.says_contents:
            contents[:] = self.columns[:, contents_at(N) : intent_at(N)].reshape(n, N, -1) == 1.0
        return contents

    @property
    def says_contents(self) -> bool:
        """Whether message columns have the group *contents*; either all worlds of a batch have it, or none has."""
        marked: bool = self.columns.shape[1] > 0 and bool((self.links[:, 0, 0, LINK.NUMBER] == 1.0).any())
        return marked

    def lacks(self, sender: int, pieces: Sequence[Piece] = USUAL_PIECES) -> tuple[Piece, ...]:
        """Return the quantities in ``pieces`` that are missing from messages of ``sender`` in one world or more."""
        always: Bools = np.logical_and.reduce(self.contents[:, sender])
        return tuple(piece for piece in pieces if not always[PIECES.index(piece)])

    def withhold_from(self, vehicle: int) -> Bools:
        """Return for each world whether messages of any vehicle but ``vehicle`` lack one of ``USUAL_PIECES``, [n]."""
        others = np.delete(self.contents, vehicle, axis=1)[:, :, : len(USUAL_PIECES)]
        return np.asarray(~others.all(axis=(1, 2)))

    def seen_from_s(self, vehicle: int, other: int) -> Floats:
        """Return the time from which ``vehicle`` measures ``other``, [n] s; infinite if never or without messages."""
        seen = self.links[:, vehicle, other, LINK.SEEN_FROM] if self.columns.shape[1] else None
        return np.full(len(self.columns), np.inf) if seen is None else seen

    def known_pieces(self, vehicle: int, time_s: Floats) -> Bools:
        """Return a mask [n, N, CONTENTS], True at (world, j, c) if ``vehicle`` knows ``PIECES[c]`` of vehicle j.

        The mask describes the time ``time_s`` [n]. It is valid for a vehicle j whose first message has arrived by then,
        and for a vehicle j in sight.
        """
        known = np.empty((len(time_s), self.vehicles, CONTENTS), np.bool_)
        _known_pieces(np.ascontiguousarray(self.columns), time_s, self.vehicles, vehicle, known)
        return known

    def intents(self, vehicle: int) -> Floats:
        """Return the newest intents that ``vehicle`` knows, [n, N] m/s2; 0 for an unknown intent."""
        n, N = len(self.columns), self.vehicles
        if not self.says_contents:
            return np.zeros((n, N))
        at, messages = intent_at(N), intent_at(N) + N + vehicle * N
        periodic = self.periodic[:, np.newaxis]
        return np.where(periodic, self.columns[:, messages : messages + N], self.columns[:, at : at + N])

    def with_intents(self, intents_mps2: Floats) -> Floats:
        """Return a copy of the message columns with the present intents ``intents_mps2`` [n, N].

        Columns without the group *intents* are returned themselves, not as a copy.
        """
        if not self.says_contents:
            return self.columns
        columns, at = self.columns.copy(), intent_at(self.vehicles)
        columns[:, at : at + self.vehicles] = intents_mps2
        return columns

    def newest_told(self, vehicle: int) -> Told:
        """Return, for every vehicle, the newest state that ``vehicle`` has received.

        All worlds must have message columns.
        """
        own, obstacle = self.columns[:, PLACES_AT + vehicle], self.columns[:, CHANNEL.OBSTACLE_PLACE]
        newest = self.links[:, vehicle]
        at_s, place, speed, command, hit = (newest[..., entry] for entry in range(LINK.TOLD_S, LINK.WIDTH))
        return Told(at_s, place, speed, command, hit, own, obstacle)

    def age_s(self, time_s: Floats) -> Floats:
        """Return the age at ``time_s`` [n] of the newest state that vehicle i received from vehicle j, [n, N, N] s.

        The age is the time since the state was sampled. It is infinite if vehicle i has received nothing from vehicle j
        yet, and 0 in a world without periodic messages, because vehicles know the present state. From the time
        ``Vehicles.known_from_s`` on, vehicle i may use the received state.
        """
        age, periodic = np.zeros((len(time_s), self.vehicles, self.vehicles)), self.periodic
        if periodic.any():
            told_s = self.links[..., LINK.TOLD_S]
            age[periodic] = np.where(told_s >= 0.0, time_s[:, np.newaxis, np.newaxis] - told_s, np.inf)[periodic]
            age[:, np.arange(self.vehicles), np.arange(self.vehicles)] = 0.0
        return age


LOOK_AHEAD: tuple[Piece, ...] = ("place", "speed", "braking_capacity", "latency", "mass")  # what a simulation needs


def refuse_untold(
    worlds: Worlds,
    vehicles: Sequence[int],
    who: str,
    needs: Sequence[Piece] = LOOK_AHEAD,
    senders: Sequence[int] | None = None,
) -> None:
    """Raise ``InvalidInput`` if messages lack a quantity that the agent ``who`` needs to control ``vehicles``.

    The agent needs the quantities ``needs`` in messages of every vehicle in ``senders`` (None: of all vehicles),
    including the controlled vehicles if it controls several. An agent that controls a single vehicle needs no message
    of this vehicle.
    """
    messages = Messages.of(worlds)
    for sender in (range(worlds.N) if senders is None else senders) if messages.says_contents else ():
        if tuple(vehicles) != (sender,) and (missing := messages.lacks(sender, needs)):
            raise InvalidInput(
                f"{who}: messages of vehicle_{sender + 1} do not contain its {missing[0]} (key v2x.tells), but"
                f" {', '.join(needs)} of the other vehicles are needed; add them to v2x.tells, or use a policy"
                " without shield and search, which needs only its observation"
            )


@compiled
def chance(key: float, link: int, number: float) -> float:
    """Return a random number in [0, 1) that decides whether a message is lost.

    The number is a pure function of the arguments: 53 bits of a SplitMix64 hash.

    Args:
        key: seed of the message losses in this world, a whole number below 2^53.
        link: number of the link, ``receiver * N + sender``.
        number: number of the message on this link, counted from 0.

    """
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
    """Advance the messages and the state of every world from its present time to ``until_s``, in place.

    The function samples all vehicles at the next decision, and at multiples of ``time_step_s`` before this decision. If
    ``until_s`` lies between two samples, vehicles in sight are also measured at ``until_s``, but the ring buffer does
    not keep this sample. If the physics cannot advance a world, the vehicles of this world receive nothing more.

    Args:
        moving: states of the worlds, [n, S], one row per world; updated.
        params: parameters of the worlds, one row per world; the message columns are updated.
        wanted: commands of the vehicles until ``until_s``, [n, N] m/s2.
        until_s: end times, [n] s.
        decision_s: time of the next decision, [n] s.
        time_step_s: time between two decisions, s.
        pieces: braking profiles of the vehicles, [N, 2 K].

    """
    column = columns(moving)
    N, head = column.vehicles, column.messages
    table = np.zeros((rows_for(pieces.shape[1]), N + 1))
    no_rows = np.empty((0, LISTED.WIDTH))
    for k in range(moving.shape[0]):
        messages = params[k, head:]
        if messages[CHANNEL.PERIOD] == 0.0:
            _choose(params[k], column, wanted[k], until_s[k])
            continue
        if messages[CHANNEL.TAKEN] == 0.0:
            _start(moving[k], params[k], column, wanted[k])
        while moving[k, column.time] < until_s[k]:
            left = math.ceil((decision_s[k] - moving[k, column.time]) / time_step_s - 1e-6) - 1.0
            end = decision_s[k] - max(left, 0.0) * time_step_s
            stops = end > until_s[k]
            if stops:
                end = until_s[k]
            if not _move(moving[k], params[k], column, wanted[k], end, pieces, table, no_rows):
                break
            _choose(params[k], column, wanted[k], moving[k, column.time])
            _sample(moving[k], messages, column)
            _receive(moving[k, column.time], messages, N)
            if stops:
                messages[CHANNEL.TAKEN] -= 1.0


@compiled
def _start(state: Floats, params: Floats, column: Columns, wanted: Floats) -> None:
    """Begin the messages of one world at the alert; update ``state`` and ``params``.

    The function sets the place of each vehicle along the road, stores the first sample of all states, and lets each
    vehicle measure the vehicles in sight.
    """
    N, obstacle, gap, force = column.vehicles, column.obstacle, column.gap, column.command
    messages, place = params[column.messages :], PLACES_AT
    messages[place] = 0.0
    messages[CHANNEL.OBSTACLE_PLACE] = state[obstacle] if state.shape[0] > obstacle else math.inf
    for p in range(N - 1):
        messages[place + p + 1] = messages[place + p] - state[gap + p]
    for i in range(N):
        acts = command_acts(params[column.latency + i], state[column.time])
        state[force + i] = force_now(
            state[force + i], wanted[i] if acts else 0.0, params[column.brake_rate + i], params[column.release_rate + i]
        )
    _choose(params, column, wanted, state[column.time])
    _sample(state, messages, column)
    _receive(state[column.time], messages, N)


@compiled
def _choose(params: Floats, column: Columns, wanted: Floats, time: float) -> None:
    """Write the intents of all vehicles at ``time``: the commands ``wanted``.

    If the V2X channel extends a vehicle's latency, the vehicle does not know of the emergency until the latency has
    elapsed. Until then its intent is 0.
    """
    messages, N = params[column.messages :], column.vehicles
    if not has_contents(messages, N):
        return
    for i in range(N):
        latency = params[column.latency + i]
        waits = latency > params[column.own_latency + i] and not command_acts(latency, time)
        messages[intent_at(N) + i] = 0.0 if waits else wanted[i]


@compiled
def _move(
    state: Floats, params: Floats, column: Columns, wanted: Floats, end: float, pieces: Floats, table: Floats,
    no_rows: Floats,
) -> bool:  # fmt: skip
    """Advance one world, and the places of its vehicles, to the time ``end``; return whether this succeeded.

    If the physics cannot advance the world, ``state`` and ``params`` are unchanged. ``table`` is working memory in the
    layout of ``physics.rows``, with N + 1 columns. ``no_rows`` [0, LISTED.WIDTH] is empty, so that no single impact is
    recorded.
    """
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
        params[column.release_rate : column.harm_weight], pieces,
    )  # fmt: skip
    for p in range(N - 1):
        table[ROW.GAP, p + 1] = state[gap + p]
        table[ROW.HIT, p + 1] = state[gap + N - 1 + p]
    if advance_table(table, params[column.restitution], end - time, time, 0, no_rows, 0)[1] != FLAG.DONE:
        return False
    place = column.messages + PLACES_AT
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
def _sample(state: Floats, messages: Floats, column: Columns) -> None:
    """Store a sample of every vehicle's state in the ring buffer of ``messages``, in place of the oldest sample."""
    N, obstacle = column.vehicles, column.obstacle
    width, first = sample_width(messages, N), ring_at(messages, N)
    at = first + width * (int(messages[CHANNEL.TAKEN]) % ((messages.shape[0] - first) // width))
    messages[at] = state[column.time]
    messages[at + 1] = state[obstacle + 1] if state.shape[0] > obstacle else 0.0
    for i in range(N):
        messages[at + RING_HEAD + i] = messages[PLACES_AT + i]
        messages[at + RING_HEAD + N + i] = state[column.speed + i]
        messages[at + RING_HEAD + 2 * N + i] = state[column.command + i]
        if width > RING_HEAD + 3 * N:
            messages[at + RING_HEAD + 3 * N + i] = messages[intent_at(N) + i]
    messages[CHANNEL.TAKEN] += 1.0


@compiled
def _receive(time: float, messages: Floats, N: int) -> None:
    """Receive all messages that may be used at ``time``, and measure the vehicles in sight; update ``messages``."""
    for i in range(N):
        for j in range(N):
            link = link_at(i, j, N)
            while messages[link + LINK.NEXT_SENT] + messages[CHANNEL.DELAY] <= time + _ON_GRID:
                u = chance(messages[CHANNEL.KEY], i * N + j, messages[link + LINK.NUMBER])
                bad = messages[link + LINK.BAD] == 1.0
                if messages[link + LINK.NUMBER] > 0.0:  # message 0 always arrives
                    bad = u >= messages[CHANNEL.LOSS_ENDS] if bad else u < messages[CHANNEL.LOSS_BEGINS]
                    messages[link + LINK.BAD] = 1.0 if bad else 0.0
                if not bad:
                    at = _take(messages, link, j, messages[link + LINK.NEXT_SENT], N)
                    if at > 0 and has_contents(messages, N):  # a later message carries a later intent
                        messages[intent_at(N) + N + i * N + j] = messages[at + RING_HEAD + 3 * N + j]
                messages[link + LINK.NUMBER] += 1.0
                messages[link + LINK.NEXT_SENT] += messages[CHANNEL.PERIOD]
            if messages[link + LINK.SEEN_FROM] <= time:
                _take(messages, link, j, time, N)


@compiled
def _take(messages: Floats, link: int, sender: int, sent_s: float, N: int) -> int:
    """Receive one message: copy the sender's state from the ring buffer to the link with first column ``link``.

    The message contains the newest sample taken at ``sent_s`` or earlier. The function copies nothing if the receiver
    already has a newer sample. It returns the first column of the message's sample, or 0 if the ring buffer no longer
    contains this sample.
    """
    width, first = sample_width(messages, N), ring_at(messages, N)
    length: int = (messages.shape[0] - first) // width
    taken = int(messages[CHANNEL.TAKEN])
    for back in range(min(length, taken)):
        at = first + width * ((taken - 1 - back) % length)
        if messages[at] <= sent_s + _ON_GRID:
            if messages[at] >= messages[link + LINK.TOLD_S]:
                messages[link + LINK.TOLD_S] = messages[at]
                messages[link + LINK.TOLD_HIT] = messages[at + 1]
                messages[link + LINK.TOLD_PLACE] = messages[at + RING_HEAD + sender]
                messages[link + LINK.TOLD_SPEED] = messages[at + RING_HEAD + N + sender]
                messages[link + LINK.TOLD_COMMAND] = messages[at + RING_HEAD + 2 * N + sender]
            return at
    return 0
