"""Messages on the links between vehicles: their samples, which message arrives when, and where its sender may be now.

A vehicle records a *sample* of its own motion at the alert and at every decision, also at those before the first one.
On each link a message is sent once per period, and used after a delay; it contains the newest sample of its sender. A
link is good or bad (Gilbert-Elliott model): with each message after the first, a good link turns bad with probability
p, and a bad one good with probability r. Messages over a bad link are lost. A neighbour in sight is measured at every
decision.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np

from ethbrake_marl.episode.plans import PLAN_NUMBERS, plans_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import hold_commands
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.elementary import hash_number
from ethbrake_marl.motion.forces import ROUNDING_S
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    FAR_M,
    FORCE,
    FOREIGN,
    GAP,
    HIT,
    LATENCY,
    LIMIT,
    OWN_LATENCY,
    RELEASE_RATE,
    SPEED,
    Bools,
    Floats,
)

MESSAGES_KEY = "messages"  # of the memory in `State.memories`
PLACE_ERRORS_KEY = "place_errors"  # of errors of places in what is sent, [n, N + 1] m

Piece = Literal["place", "speed", "acceleration", "braking_capacity", "latency", "mass", "intent", "plan"]
PIECES: tuple[Piece, ...] = get_args(Piece)
P_PLACE, P_SPEED, P_ACCELERATION, P_BRAKING, P_LATENCY, P_MASS, P_INTENT, P_PLAN = range(len(PIECES))

# rows of a sample: one body at one moment
AT = 0  # time of the sample (s); infinite: there is none
PLACE = 1  # of its front (m along the road; 0 is the front of Vehicle 1 at the alert, lengths of vehicles not counted)
SAMPLE_SPEED = 2  # m/s
SAMPLE_FORCE = 3  # m/s2
OBSTACLE_HIT = 4  # 1 once Vehicle 1 has hit the obstacle
PLACE_ERROR = 5  # of its place, as others receive it (m)
INTENT = 6  # command chosen at the last decision (m/s2); the rows before it can be measured
PLAN = slice(7, 7 + PLAN_NUMBERS)  # plan in force since the last decision (``episode.plans``)
SAMPLE_ROWS = PLAN.stop

# columns of `MessageMemory.channel`
PERIOD = 0  # time between two messages of a link (s); 0: what is known is always the present state
DELAY = 1  # time from sending a message to its use (s)
LOSS_BEGINS = 2  # p
LOSS_ENDS = 3  # r
KEY = 4  # whole number below 2^53 that decides which messages are lost
CHANNEL_COLUMNS = 5

# rows of `MessageMemory.links`
SENT = 0  # time at which the next message is sent (s); infinite: none
MESSAGE_NUMBER = 1  # its number; message 0 always arrives
BAD = 2  # 1 while the link is bad
LINK_ROWS = 3

FRONT_POST_M = 1e6  # gap to a post ahead of the line, out of reach; what the gap loses is the way of Vehicle 1
SAME_MOMENT_S = 1e-9  # two moments that are closer are the same (s)


class MessageMemory(NamedTuple):
    """What the vehicles of n worlds have sent and received.

    In arrays [..., N + 1, N + 1], the entry [..., i, j] is what body i has received from, or knows of, body j.
    """

    contents: Bools  # [n, N + 1, PIECES] whether messages of a body contain the piece
    heard_s: Floats  # [n, N + 1, N + 1] when the first message can be used (s); infinite: never
    seen_s: Floats  # [n, N + 1, N + 1] when i begins to measure j (s); infinite: never
    channel: Floats  # [n, CHANNEL_COLUMNS]
    links: Floats  # [n, LINK_ROWS, N + 1, N + 1]
    news: Floats  # [n, SAMPLE_ROWS, N + 1, N + 1] the newest sample received; AT below 0: none
    samples: Floats  # [n, L, SAMPLE_ROWS, N + 1] the last L samples, newest first; L is 0 without periodic messages

    @property
    def is_periodic(self) -> bool:
        """Whether messages are periodic, so that known values may be old."""
        return self.samples.shape[1] > 0


def samples_kept(delay_s: float, time_step_s: float) -> int:
    """Number of samples to store so that a delayed message still finds the sample that it contains.

    These are the samples of one delay, and three more.
    """
    return math.ceil(delay_s / time_step_s - SAME_MOMENT_S) + 3


def memory_at_alert(
    contents: Bools, heard_s: Floats, seen_s: Floats, channel: Floats, sample_count: int
) -> MessageMemory:
    """Memory at the alert, before any message.

    ``contents`` [N, PIECES]: what messages of each vehicle contain. ``heard_s`` and ``seen_s`` [n, N, N]: when vehicle
    i can use the first message of j, and when it begins to measure j (s). ``channel``: as in ``MessageMemory``.
    ``sample_count``: number of samples to store.
    """
    n, N = heard_s.shape[:2]
    all_contents = np.ones((n, N + 1, len(PIECES)), np.bool_)
    all_contents[:, 1:] = contents
    heard_at, seen_at = np.full((2, n, N + 1, N + 1), np.inf)
    pairs = ~np.eye(N, dtype=np.bool_)
    heard_at[:, 1:, 1:], seen_at[:, 1:, 1:] = np.where(pairs, heard_s, np.inf), np.where(pairs, seen_s, np.inf)
    links, news = np.zeros((n, LINK_ROWS, N + 1, N + 1)), np.zeros((n, SAMPLE_ROWS, N + 1, N + 1))
    samples = np.zeros((n, sample_count, SAMPLE_ROWS, N + 1))
    links[:, SENT], news[:, AT], samples[:, :, AT] = heard_at - channel[:, DELAY, np.newaxis, np.newaxis], -1.0, np.inf
    return MessageMemory(all_contents, heard_at, seen_at, channel, links, news, samples)


def present(state: State) -> Floats:
    """Sample that each body would send now, [n, SAMPLE_ROWS, N + 1] (body 0: the obstacle).

    Places are relative to Vehicle 1. The intent of a vehicle is its last command, or 0 before it knows of the alert;
    until then it has no plan.
    """
    sample = np.zeros((state.n, SAMPLE_ROWS, state.vehicles + 1))
    latency, time = state.car[:, LATENCY], state.time_s[:, np.newaxis]
    waits = (latency > state.car[:, OWN_LATENCY]) & ~((latency <= 0.0) | (latency < time - ROUNDING_S))
    sample[:, AT], sample[:, SAMPLE_SPEED], sample[:, SAMPLE_FORCE] = time, state.line[:, SPEED], state.line[:, FORCE]
    sample[:, OBSTACLE_HIT], sample[:, INTENT] = state.line[:, HIT, :1], np.where(waits, 0.0, state.wanted)
    sample[:, PLAN] = np.where(waits[:, np.newaxis], np.nan, plans_of(state))
    sample[:, PLACE, 0], sample[:, PLACE, 2:] = state.line[:, GAP, 0], -np.cumsum(state.gaps_m, axis=1)
    sample[:, PLACE_ERROR] = state.memories.get(PLACE_ERRORS_KEY, 0.0)
    return sample


def begin_messages(alert: State, start_s: Floats, time_step_s: float, sent: Callable[[State], State]) -> MessageMemory:
    """Memory at the first decision, ``start_s`` [n] (s), with what has been received since the alert.

    Before the first decision, vehicles execute ``alert.wanted``. ``sent``: function from the true state to the state
    that vehicles send and measure.
    """
    memory, line = _writable_copy(alert.memories[MESSAGES_KEY]), alert.line.copy()
    force = np.where(alert.car[:, LATENCY] <= 0.0, alert.wanted, 0.0)
    rate = np.where(force < line[:, FORCE], alert.car[:, BRAKE_RATE], alert.car[:, RELEASE_RATE])
    line[:, FORCE] = np.where(np.isinf(rate), force, line[:, FORCE])
    memory.samples[:, 0, PLACE, 0] = line[:, GAP, 0]
    state = alert._replace(line=line)
    _sample(memory, sent(state), np.zeros(alert.n), np.ones(alert.n, np.bool_))
    steps = np.ceil(start_s / time_step_s - 1e-6)
    for steps_left in range(int(steps.max()) - 1, -1, -1):
        rows = steps > steps_left
        state, way = _advance(state, np.where(rows, start_s - steps_left * time_step_s, state.time_s))
        _sample(memory, sent(state), way, rows)
    return memory


def after_step(before: State, after: State, sent: Callable[[State], State]) -> MessageMemory:
    """Memory after a step, with what was received during the step. ``sent``: as for ``begin_messages``."""
    memory = _writable_copy(before.memories[MESSAGES_KEY])
    _, way = _advance(before._replace(wanted=after.wanted), after.time_s)
    _sample(memory, sent(after), way, after.time_s > before.time_s)
    return memory


def _writable_copy(memory: MessageMemory) -> MessageMemory:
    return memory._replace(links=memory.links.copy(), news=memory.news.copy(), samples=memory.samples.copy())


def _advance(state: State, until_s: Floats) -> tuple[State, Floats]:
    """State at ``until_s`` [n], and the way of Vehicle 1 until then, [n] m.

    The way is the amount by which the gap to the obstacle, or to a post far ahead, falls.
    """
    line = state.line.copy()
    line[line[:, GAP, 0] >= FAR_M, GAP, 0] = FRONT_POST_M
    after = hold_commands(state._replace(line=line), until_s)
    return after, line[:, GAP, 0] - after.line[:, GAP, 0]


def _sample(memory: MessageMemory, state: State, way_m: Floats, rows: Bools) -> None:
    """Add a sample of ``state`` to ``memory`` in the worlds ``rows`` (a mask [n]), and receive what arrives, in place.

    ``way_m`` [n]: way of Vehicle 1 since the last sample.
    """
    sample, samples = present(state), memory.samples
    sample[:, PLACE, 1:] += (samples[:, 0, PLACE, 1] + way_m)[:, np.newaxis]
    sample[:, PLACE, 0] = samples[:, 0, PLACE, 0]
    samples[rows, 1:] = samples[rows, :-1]
    samples[rows, 0] = sample[rows]
    receive_worlds(rows, state.time_s.copy(), memory.channel, memory.seen_s, samples, memory.links, memory.news)


def newest_samples(state: State, observer: int) -> Floats:
    """Newest sample (recorded motion) that the body ``observer`` has of each body, [n, SAMPLE_ROWS, N + 1].

    Its own place is exact, others' places contain their errors.
    """
    memory: MessageMemory = state.memories[MESSAGES_KEY]
    if not memory.is_periodic:
        return present(state)
    news = memory.news[:, :, observer].copy()
    news[:, PLACE] += news[:, PLACE_ERROR]
    news[:, :, observer], news[:, PLACE, 0] = memory.samples[:, 0, :, observer], memory.samples[:, 0, PLACE, 0]
    return news


def estimated_line(state: State, observer: int, known: Bools, news: Floats) -> Floats:
    """Array ``State.line`` as the body ``observer`` estimates it; arguments: as for ``estimate_worlds``."""
    line, bodies, aged = state.line.copy(), known.shape[1], state.memories[MESSAGES_KEY].is_periodic
    working = np.empty(bodies), np.empty(bodies, np.bool_)
    estimate_worlds(observer, state.time_s.copy(), state.car[:, LIMIT].copy(), known, news, aged, line, *working)
    return line


@large
def receive_worlds(rows, time, channel, seen_s, samples, links, news):
    """Receive all messages that can be used by ``time`` [n] (s), and measure vehicles in sight, in the worlds ``rows``.

    ``rows`` is a mask [n]. The other arguments are arrays of ``MessageMemory``; ``links`` and ``news`` are changed in
    place.
    """
    bodies = news.shape[3]
    for k in range(len(rows)):
        for link in range(bodies * bodies if rows[k] else 0):
            i, j = link // bodies, link % bodies
            while links[k, SENT, i, j] + channel[k, DELAY] <= time[k] + SAME_MOMENT_S:
                number, bad = links[k, MESSAGE_NUMBER, i, j], links[k, BAD, i, j] == 1.0
                if number > 0.0:
                    u = hash_number(channel[k, KEY], (i - 1) * (bodies - 1) + j - 1, number)
                    bad = u >= channel[k, LOSS_ENDS] if bad else u < channel[k, LOSS_BEGINS]
                if not bad:
                    take_sample(samples[k], news[k], i, j, links[k, SENT, i, j], SAMPLE_ROWS)
                links[k, BAD, i, j] = 1.0 if bad else 0.0
                links[k, MESSAGE_NUMBER, i, j] += 1.0
                links[k, SENT, i, j] += channel[k, PERIOD]
            if seen_s[k, i, j] <= time[k]:
                take_sample(samples[k], news[k], i, j, time[k], INTENT)


@kernel
def take_sample(samples, news, i, j, sent, rows):
    """Copy rows of a sample of body j to what body i has received: the newest sample taken at ``sent`` (s) or before.

    Only the first ``rows`` rows are copied. One world: ``samples`` [L, SAMPLE_ROWS, N + 1], newest first; ``news``
    [SAMPLE_ROWS, N + 1, N + 1] is changed.
    """
    for s in range(samples.shape[0]):
        if samples[s, AT, j] <= sent + SAME_MOMENT_S:
            for row in range(rows):
                news[row, i, j] = samples[s, row, j]
            return


@kernel
def moved_on(speed, force, limit, duration):
    """Speed (m/s) and way (m) of a vehicle after ``duration`` (s) under a constant force, without contact.

    ``force``: acceleration (m/s2). ``limit``: speed up to which the vehicle drives (m/s). A vehicle that moves backward
    brakes to rest, whatever the sign of its force.
    """
    if speed >= 0.0:
        after, way, _ = solo(speed, force, 0.0, limit, duration)
        return after, way
    force = abs(force)
    braking = min(duration, -speed / force) if force > 0.0 else duration
    return min(speed + force * braking, 0.0), (speed + 0.5 * force * braking) * braking


@large
def estimate_worlds(observer, time, limit, known, news, aged, line, place, fresh):
    """Overwrite the true ``line`` (``State.line``) with the line as the body ``observer`` estimates it.

    The newest sample of each body, ``news`` [n, SAMPLE_ROWS, N + 1], is extrapolated to ``time`` [n] (s) with a
    constant force, up to the speed ``limit`` [n, N + 1] (m/s), and without contact. The gap between two bodies with
    samples of the present is the true one. If the place of a body is not ``known`` [n, N + 1, PIECES], the place of the
    next body towards the observer is used; an unknown speed or force is 0. If samples may be old (``aged``), the
    observer knows of no impact between other vehicles. ``place`` and ``fresh`` [N + 1]: memory, overwritten.
    """
    bodies = line.shape[2]
    for k in range(len(time)):
        place[observer], fresh[observer] = news[k, PLACE, observer], True
        for way in (-1, 1):
            j = observer + way
            while 0 < j < bodies:
                age = time[k] - news[k, AT, j]
                force = news[k, SAMPLE_FORCE, j] if known[k, j, P_ACCELERATION] else 0.0
                speed, passed = 0.0, 0.0
                if known[k, j, P_SPEED]:
                    speed, passed = moved_on(news[k, SAMPLE_SPEED, j], force, limit[k, j], age)
                place[j] = news[k, PLACE, j] + passed if known[k, j, P_PLACE] else place[j - way]
                fresh[j] = known[k, j, P_PLACE] and age <= 0.0
                line[k, SPEED, j], line[k, FORCE, j], line[k, FOREIGN, j] = speed, force, 0.0
                j += way
        for p in range(1, bodies - 1):
            if not (fresh[p] and fresh[p + 1]):
                line[k, GAP, p] = max(place[p] - place[p + 1], 0.0)
            if aged and p != observer and p + 1 != observer:
                line[k, HIT, p] = 0.0
        if observer > 1:
            line[k, GAP, 0] = max(news[k, PLACE, 0] - place[1], 0.0) if known[k, 1, P_PLACE] else FAR_M
            line[k, HIT, 0] = news[k, OBSTACLE_HIT, 1]
