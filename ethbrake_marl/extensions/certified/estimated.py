"""What one vehicle can know of its line: *possible lines*, made from its messages and the scenario's ranges.

A value of another vehicle that has not been received is drawn from its range: a fixed Latin hypercube, the same for
each world and batch. The possible lines are simulated in parallel with the episode, from the alert on, with the
vehicle's own actions; the others follow their scripts. Received and measured values replace assumed ones. Nothing else
of the true state is read.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.messages.belief import known_pieces
from ethbrake_marl.extensions.messages.links import (
    AT,
    MESSAGES_KEY,
    OBSTACLE_HIT,
    P_ACCELERATION,
    P_BRAKING,
    P_INTENT,
    P_LATENCY,
    P_MASS,
    P_PLACE,
    P_SPEED,
    PIECES,
    PLACE,
    SAMPLE_FORCE,
    SAMPLE_SPEED,
    newest_samples,
    present,
)
from ethbrake_marl.extensions.messages.reports import chances
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.interval import solo
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    DRIVING,
    FIRST,
    FORCE,
    GAP,
    HIT,
    IMPACTS,
    LATENCY,
    LIMIT,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    TOTAL,
    Bools,
    Floats,
)
from ethbrake_marl.worlds.channel import PER_LINK
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantities import NEWS
from ethbrake_marl.worlds.roles import HOLDING_SCRIPTS, LEARNER, first_command
from ethbrake_marl.worlds.sampling import draw_once
from ethbrake_marl.worlds.scenario import Scenario

PIECE_OF_CAR_ROW = {  # rows of `State.car` -> the piece of a message that tells them
    BRAKING: P_BRAKING,
    DRIVING: P_BRAKING,
    BRAKE_RATE: P_BRAKING,
    RELEASE_RATE: P_BRAKING,
    LIMIT: P_BRAKING,
    OWN_LATENCY: P_LATENCY,
    MASS: P_MASS,
}
OF_IMPACTS = [HIT, FIRST, TOTAL, IMPACTS]


class News(NamedTuple):
    """What a vehicle has received of each body. A body is *located* if its place and speed have been received.

    Body 0 is the obstacle; a vehicle knows its place as soon as it knows the place of Vehicle 1.
    """

    pieces: Bools  # [n, N + 1, PIECES] what has been received (``messages.links``)
    sample: Floats  # [n, SAMPLE_ROWS, N + 1] the newest values
    located: Bools  # [n, N + 1]; never the obstacle, body 0
    at_s: Floats  # [n, N + 1] time of the newest sample; 0 for a body that is not located

    @property
    def with_force(self) -> Bools:
        """Whether a body is located and its acceleration has also been received, [n, N + 1]."""
        return self.located & self.pieces[:, :, P_ACCELERATION]

    def fresh(self, state: State) -> Bools:
        """Whether a body is located by a sample taken at the present time of ``state``, [n, N + 1]."""
        return self.located & (self.at_s >= state.time_s[:, np.newaxis])

    def speeds_and_ways(
        self, speed: Floats, wanted: Floats, onset: Floats, limit: Floats, time_s: Floats
    ) -> tuple[Floats, Floats]:
        """Speeds (m/s) at ``time_s`` ([n, 1], s), and distances (m) driven since the newest samples; both [n, N + 1].

        Contacts are ignored. Bodies that are not located keep their ``speed``. Located ones accelerate at ``wanted``
        (m/s2) from ``onset`` (s after the alert), up to ``limit`` (m/s).
        """
        speed, way = np.where(self.located, self.sample[:, SAMPLE_SPEED], speed), np.zeros(speed.shape)
        move_on(speed, way, wanted, onset - self.at_s, limit, np.where(self.located, time_s - self.at_s, 0.0))
        return speed, way


class PossibleLines(NamedTuple):
    """The M lines that the vehicle ``body`` assumes before it has received anything; or M lines for each of n worlds.

    In arguments and results, rows belong to lines: first the M lines of world 0.
    """

    body: int
    alert: State  # [n M] at the alert
    news_s: Floats  # [n M, N + 1] when each vehicle receives the alert (s)
    roles: tuple[str, ...]  # of the vehicles, front to rear

    @classmethod
    def of(cls, scenario: Scenario, body: int, M: int) -> PossibleLines:
        """M possible lines, M = 1: that of all medians. Raises the errors of ``check_predictable``."""
        check_predictable(scenario, body)
        N, numbers = scenario.vehicles, hypercube(M)
        alert = draw_once(scenario, numbers, np.zeros(M, np.int64)).worlds._replace(memories={})
        news = np.zeros((M, N + 1))
        links = numbers(PER_LINK * N * N, NEWS)
        news[:, 1:] = scenario.v2x.news(np.zeros((M, N)), links, scenario.unheard())[0]
        alert.car[:, LATENCY] = np.maximum(alert.car[:, OWN_LATENCY], news)
        return cls(body, alert, news, tuple(scenario.roles.values()))

    def for_worlds(self, n: int) -> PossibleLines:
        return self._replace(
            alert=self.alert.take(np.tile(np.arange(self.alert.n), n)), news_s=np.tile(self.news_s, (n, 1))
        )

    def commands(self, car: Floats, wanted: Floats) -> Floats:
        """Commands of all bodies, [n, N + 1] m/s2 (body 0: the obstacle).

        Scripts command as always, other learners brake fully, and ``self.body`` keeps its command in ``wanted``.
        """
        wanted = wanted.copy()
        for vehicle, role in enumerate(self.roles, 1):
            if vehicle != self.body:
                wanted[:, vehicle] = first_command("full_brake" if role == LEARNER else role, car[:, BRAKING, vehicle])
        return wanted

    def at_alert(self, alert: State, state: State) -> State:
        """Lines at the alert with what the vehicle knows at the first decision ``state``.

        Vehicles that are completely known by then start as in ``alert``, and so do the gaps between them. Raises
        ``InvalidInput`` for worlds that depart from what the vehicle can estimate.
        """
        require(alert, "an estimated line", SHOWN)
        news = self.received(state)
        known = np.asarray(news.pieces[:, :, :P_INTENT].all(axis=2))
        known[:, 0] = known[:, 1]
        acts = known & (news.sample[:, SAMPLE_FORCE] != 0.0)
        acts[:, self.body] = True
        line, car = (np.where(known[:, np.newaxis], *arrays) for arrays in zip(alert[:2], self.alert[:2], strict=True))
        pair_known = known[:, :-1] & known[:, 1:]
        line[:, GAP, :-1] = np.where(pair_known, alert.line[:, GAP, :-1], self.alert.line[:, GAP, :-1])
        car[:, RESTITUTION] = alert.car[:, RESTITUTION]
        car[:, LATENCY] = np.where(acts, alert.car[:, LATENCY], np.maximum(car[:, OWN_LATENCY], self.news_s))
        return alert._replace(line=line, car=car, wanted=self.commands(car, alert.wanted))

    def received(self, state: State) -> News:
        """What the vehicle has received until the time of the true ``state``."""
        if MESSAGES_KEY in state.memories:
            pieces, sample = known_pieces(state, self.body), newest_samples(state, self.body)
        else:
            known = state.know[:, self.body] <= state.time_s[:, np.newaxis]
            known[:, [0, self.body]] = True
            pieces, sample = known[:, :, np.newaxis].repeat(len(PIECES), axis=2), present(state)
        pieces[:, 0] = False
        pieces[:, 0, P_PLACE] = pieces[:, 1, P_PLACE]
        located = np.asarray(pieces[:, :, [P_PLACE, P_SPEED]].all(axis=2))
        located[:, 0] = False
        return News(pieces, sample, located, np.where(located, sample[:, AT], 0.0))

    def with_received(self, state: State, lines: State) -> State:
        """The ``lines`` now, with received values in place of assumed ones; ``state`` is the true state now.

        A received place and speed are extrapolated to the present by the sender's script, without contact. A sender
        that was not accelerating is assumed to react no earlier than at its sample. A vehicle with an unknown place
        keeps its distance to this vehicle, as far as the order of the line allows.
        """
        body, news = self.body, self.received(state)
        line, car = lines.line.copy(), lines.car.copy()
        for row, piece in PIECE_OF_CAR_ROW.items():
            car[:, row, 1:] = np.where(news.pieces[:, 1:, piece], state.car[:, row, 1:], car[:, row, 1:])
        onset = self.onsets(news, car)
        car[:, LATENCY], car[:, LATENCY, body] = onset, state.car[:, LATENCY, body]
        wanted = self.commands(car, state.wanted)
        speed, way = news.speeds_and_ways(line[:, SPEED], wanted, onset, car[:, LIMIT], state.time_s[:, np.newaxis])
        line[:, SPEED] = speed
        line[:, GAP] = self.gaps(news, way, lines, state)
        line[:, FORCE] = self.forces(news, wanted, onset, lines, state)
        line[:, OF_IMPACTS, body - 1 : body + 1] = state.line[:, OF_IMPACTS, body - 1 : body + 1]
        if body > 1:
            line[:, HIT, 0] = np.where(news.pieces[:, 1, P_PLACE], news.sample[:, OBSTACLE_HIT, 1], line[:, HIT, 0])
        return lines._replace(line=line, car=car, wanted=wanted)

    def onsets(self, news: News, car: Floats) -> Floats:
        """Time from which each vehicle reacts, as this vehicle assumes, [n, N + 1] s after the alert."""
        later = np.maximum(np.maximum(car[:, OWN_LATENCY], self.news_s), news.at_s)
        accelerates = news.with_force & (news.sample[:, SAMPLE_FORCE] != 0.0)
        return np.where(accelerates, news.at_s, np.where(news.located, later, car[:, LATENCY]))

    def gaps(self, news: News, way: Floats, lines: State, state: State) -> Floats:
        """Gaps ahead of all vehicles as this vehicle estimates them, [n, N + 1] m, as in the row GAP of ``State.line``.

        Positions are those of the newest samples plus ``way`` [n, N + 1] (m), the distance driven since then; unknown
        ones come from ``lines``. Between two vehicles with samples of the present, the gap is the true one.
        """
        body, gaps = self.body, lines.line[:, GAP].copy()
        place = np.zeros(way.shape)  # distance from this vehicle (m)
        place[:, 2:] = -np.cumsum(gaps[:, 1:-1], axis=1)
        received = news.sample[:, PLACE] + way - news.sample[:, PLACE, [body]]
        place = np.where(news.located, received, place - place[:, [body]])
        obstacle = news.sample[:, PLACE, 0] - news.sample[:, PLACE, body]
        ahead = np.where(news.pieces[:, 0, P_PLACE], obstacle, gaps[:, 0] + place[:, 1])
        place[:, body:0:-1] = in_order(place[:, body:0:-1], news.located[:, body:0:-1])
        place[:, body:] = -in_order(-place[:, body:], news.located[:, body:])
        fresh = news.fresh(state)
        exact = fresh[:, 1:-1] & fresh[:, 2:]
        gaps[:, 1:-1] = np.where(exact, state.gaps_m, np.maximum(place[:, 1:-1] - place[:, 2:], 0.0))
        gaps[:, 0] = state.line[:, GAP, 0] if body == 1 else np.maximum(ahead - place[:, 1], 0.0)
        return gaps

    def forces(self, news: News, wanted: Floats, onset: Floats, lines: State, state: State) -> Floats:
        """Estimated acceleration of each body by its brakes or engine, [n, N + 1] m/s2.

        0 before the ``onset`` (s after the alert), afterwards the command ``wanted`` (m/s2). An acceleration in a
        sample of the present replaces both. Bodies that are not located keep theirs in ``lines``.
        """
        reacting = np.where((onset <= 0.0) | (onset < state.time_s[:, np.newaxis]), wanted, 0.0)
        force = np.where(news.located, reacting, lines.line[:, FORCE])
        force = np.where(news.fresh(state) & news.with_force, news.sample[:, SAMPLE_FORCE], force)
        force[:, self.body] = state.line[:, FORCE, self.body]
        return force


def hypercube(M: int) -> Numbers:
    """Source of M numbers in (0, 1) for each place, one in each M-th part, in an order that depends on the place."""

    def numbers(width: int, stream: tuple[int, ...]) -> Floats:
        keys, hashes = np.arange(M, dtype=np.float64), np.empty((M, width))
        chances(keys, np.full(M, float(sum(part * 1000**k for k, part in enumerate((width, *stream))))), hashes)
        return (hashes.argsort(axis=0).argsort(axis=0) + 0.5) / M

    return numbers


def check_predictable(scenario: Scenario, body: int) -> None:
    """Raise ``InvalidInput`` if the vehicle ``body`` cannot predict the line."""
    where = f"scenario {scenario.name!r}: plan:estimated needs"
    if scenario.members:
        names = ", ".join(member.name for member in scenario.members)
        raise InvalidInput(f"{where} the ranges of one scenario, but this is a mixture; give one of {names}")
    for vehicle, (name, role) in enumerate(scenario.roles.items(), 1):
        if vehicle != body and role.partition(":")[0] not in (LEARNER, *HOLDING_SCRIPTS):
            raise InvalidInput(f"{where} vehicles whose commands are known, but {name} is driven by {role!r}")


def in_order(place: Floats, known: Bools) -> Floats:
    """Places (m), [n, vehicles], raised where they would decrease from one vehicle to the next.

    An unknown place that lies beyond the next ``known`` one is first lowered to it.
    """
    limit = np.where(known, place, np.inf)[:, ::-1]
    within = np.minimum(place, np.minimum.accumulate(limit, axis=1)[:, ::-1])
    return np.maximum.accumulate(within, axis=1)


@large
def move_on(speed, way, wanted, onset, limit, age):
    """Advance vehicles by ``age`` (s) without contact: from ``onset`` (s) on they accelerate with ``wanted`` (m/s2).

    All arrays are [n, N + 1]; ``speed`` (m/s, at most ``limit``) and ``way`` (m) are overwritten.
    """
    for k in range(speed.shape[0]):
        for i in range(speed.shape[1]):
            if age[k, i] > 0.0:
                speed[k, i], way[k, i], _ = solo(
                    max(speed[k, i], 0.0), wanted[k, i], onset[k, i], limit[k, i], age[k, i]
                )
