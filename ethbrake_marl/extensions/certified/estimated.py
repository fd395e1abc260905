"""What one vehicle can know of its line: *estimated lines*, made from its messages and the scenario's ranges.

A value of another vehicle that has not been received is its median in the *median line*, and an end of its range in
every *corner*. Each estimated line is simulated beside the episode, from the alert on, with the vehicle's own actions;
the others follow their scripts. It is dropped when the vehicle receives or measures something that contradicts it. If
all are contradicted, the truth lies between the corners: then received values replace assumed ones in all of them, and
the rest goes on as before.

Nothing else of the true state is read, so what was not received cannot change an estimated line.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.uncertainty import MOST_CORNERS
from ethbrake_marl.extensions.messages.belief import known_pieces
from ethbrake_marl.extensions.messages.links import (
    AT,
    NAME,
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
    newest,
    present,
)
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.drive import solo
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    COUNT,
    DRIVING,
    FIRST,
    FORCE,
    GAP,
    HIT,
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
from ethbrake_marl.worlds.roles import HELD, LEARNER, first_command
from ethbrake_marl.worlds.sampling import draw_once
from ethbrake_marl.worlds.scenario import Scenario

SURPRISE = 1e-6  # by which a quantity (SI units, t) may differ from its prediction: messages are moved on with rounding
RANGES = {"speeds_mps": SPEED, "braking_capacity_mps2": BRAKING, "mass_t": MASS, "latency_s": OWN_LATENCY}
TOLD = {  # rows of `State.car` -> the piece of a message that tells them
    BRAKING: P_BRAKING,
    DRIVING: P_BRAKING,
    BRAKE_RATE: P_BRAKING,
    RELEASE_RATE: P_BRAKING,
    LIMIT: P_BRAKING,
    OWN_LATENCY: P_LATENCY,
    MASS: P_MASS,
}
OF_IMPACTS = [HIT, FIRST, TOTAL, COUNT]


class Lines(NamedTuple):
    """The M estimated lines of the vehicle ``body`` before it has received anything, the median line first."""

    body: int
    alert: State  # [M] at the alert
    news_s: Floats  # [M, N + 1] when each vehicle has received the alert (s)
    roles: tuple[str, ...]  # of the vehicles, front to rear

    @classmethod
    def of(cls, scenario: Scenario, body: int, *, corners: bool) -> Lines:
        """Return the median line of a scenario and, with ``corners``, lines with unknown quantities at the ends of
        their ranges.

        Unknown to the vehicle ``body`` are the gaps and, of each other vehicle, speed, braking capacity, mass, latency,
        and when it receives the alert. Raises ``InvalidInput`` for a mixture of scenarios, for other vehicles with
        unknown commands, and for too many corners.
        """
        where = f"scenario {scenario.name!r}: estimated agents and shields need"
        if scenario.members:
            names = ", ".join(member.name for member in scenario.members)
            raise InvalidInput(f"{where} the ranges of one scenario, but this is a mixture; give one of {names}")
        for other, (name, role) in enumerate(scenario.roles.items(), 1):
            if other != body and role.partition(":")[0] not in (LEARNER, *HELD):
                raise InvalidInput(f"{where} vehicles whose commands are known, but {name} is driven by {role!r}")
        N, channel, of = scenario.vehicles, scenario.v2x, scenario.unheard()
        median = draw_once(scenario, lambda width, stream: np.full((1, width), 0.5), np.zeros(1, np.int64)).worlds
        late = channel.latest_reaction_s(np.zeros((1, N)), of)
        usual = channel.news(np.zeros((1, N)), np.full((1, PER_LINK * N * N), 0.5), of)[0] if late.any() else late
        sides = [("gaps_m", p, *ends) for p, ends in enumerate(scenario.bounds("gaps_m"), 1)]
        sides += [(key, j, *ends) for key in RANGES for j, ends in enumerate(scenario.bounds(key), 1) if j != body]
        sides += [("news_s", j, 0.0, float(late[0, j - 1])) for j in range(1, N + 1) if j != body]
        sides = [side for side in sides if side[2] < side[3]] if corners else []
        if 2 ** len(sides) > MOST_CORNERS:
            raise InvalidInput(
                f"robust:estimated: scenario {scenario.name!r} has {len(sides)} unknown quantities; their smallest and"
                f" largest values make {2 ** len(sides)} combinations (corners), but at most {MOST_CORNERS} are"
                " allowed; give fewer quantities a range"
            )
        ends = [side[2:] for side in sides]
        values = np.array([*product(*ends)]).reshape(-1, len(sides)) if sides else np.zeros((0, 0))
        alert = median.take(np.zeros(1 + len(values), np.int64))
        news = np.zeros((alert.n, N + 1))
        news[:, 1:] = usual
        for (key, column, *_), each in zip(sides, values.T, strict=True):
            array = news if key == "news_s" else alert.line[:, GAP] if key == "gaps_m" else None
            if array is None:
                array = (alert.line if key == "speeds_mps" else alert.car)[:, RANGES[key]]
            array[1:, column] = each
        alert.car[:, LATENCY] = np.maximum(alert.car[:, OWN_LATENCY], news)
        return cls(body, alert, news, tuple(scenario.roles.values()))

    def commands(self, car: Floats, wanted: Floats) -> Floats:
        """Return the commands of all bodies, [n, N + 1] m/s2 (body 0: the obstacle).

        Scripts follow their rules, other learners brake fully, and the vehicle itself keeps ``wanted`` [n, N + 1].
        ``car``: as in ``State``.
        """
        wanted = wanted.copy()
        for other, role in enumerate(self.roles, 1):
            if other != self.body:
                wanted[:, other] = first_command("full_brake" if role == LEARNER else role, car[:, BRAKING, other])
        return wanted

    def at_alert(self, alert: State, state: State) -> State:
        """Return the estimated lines at the alert, M rows for each world.

        They use what ``state`` shows at the first decision. Vehicles of which everything is known by then start as in
        the true world ``alert``, and so does the gap between two of them.
        """
        M, (pieces, news) = self.alert.n, self.received(state)
        lines, true = self.alert.take(np.tile(np.arange(M), alert.n)), alert.take(np.arange(alert.n).repeat(M))
        whole = np.asarray(pieces[:, :, :P_INTENT].all(axis=2))
        whole[:, 0] = whole[:, 1]
        acts = (whole & (news[:, SAMPLE_FORCE] != 0.0)).repeat(M, axis=0)
        acts[:, self.body] = True
        known = whole.repeat(M, axis=0)
        line, car = (np.where(known[:, np.newaxis], *each) for each in zip(true[:2], lines[:2], strict=True))
        both = known[:, :-1] & known[:, 1:]
        line[:, GAP, :-1] = np.where(both, true.line[:, GAP, :-1], lines.line[:, GAP, :-1])
        car[:, RESTITUTION] = true.car[:, RESTITUTION]
        heard = np.maximum(car[:, OWN_LATENCY], np.tile(self.news_s, (alert.n, 1)))
        car[:, LATENCY] = np.where(acts, true.car[:, LATENCY], heard)
        return true._replace(line=line, car=car, wanted=self.commands(car, true.wanted))

    def received(self, state: State) -> tuple[Bools, Floats]:
        """Return which quantities of each body the vehicle has received, [n, N + 1, PIECES], and the newest values.

        The values are [n, SAMPLE_ROWS, N + 1] (``messages.links``, as are PIECES). Body 0 is the obstacle, whose place
        is known to all who know the place of Vehicle 1.
        """
        if NAME in state.memories:
            pieces, news = known_pieces(state, self.body), newest(state, self.body)
        else:
            known = state.know[:, self.body] <= state.time_s[:, np.newaxis]
            known[:, [0, self.body]] = True
            pieces, news = known[:, :, np.newaxis].repeat(len(PIECES), axis=2), present(state)
        pieces[:, 0] = False
        pieces[:, 0, P_PLACE] = pieces[:, 1, P_PLACE]
        return pieces, news

    def heard(self, state: State, lines: State) -> tuple[State, Bools, Bools]:
        """Return the estimated lines after news, and in which worlds any, and not all, agreed with it, [n] each.

        ``state``: the truth now. ``lines``: the lines now, M rows for each world. A contradicted line becomes a copy of
        one that agrees; if none agrees, ``overwritten`` corrects all of them.
        """
        n, M = state.n, lines.n // state.n
        possible = self.agrees(state, lines)
        some = np.asarray(possible.any(axis=1))
        kept = np.where(possible | ~some[:, np.newaxis], np.arange(M), possible.argmax(axis=1)[:, np.newaxis])
        changed = ~np.asarray(possible.all(axis=1))
        if changed.any():
            lines = lines.take((np.arange(n)[:, np.newaxis] * M + kept).ravel())
        if not some.all():
            rows = (~some).repeat(M).nonzero()[0]
            lines = lines.put(rows, self.overwritten(state.take(rows // M), lines.take(rows)), donate=True)
        return lines, some, changed

    def agrees(self, state: State, lines: State) -> Bools:
        """Return in which estimated lines the vehicle would have received and measured the same, [n, M].

        ``state``: the truth now. ``lines``: the lines now, M rows for each world.
        """
        pieces, news = self.received(state)
        mine, theirs = self.told(state, news), self.told(lines, self.received(lines)[1])
        far = np.abs(theirs.reshape(state.n, -1, *mine.shape[1:]) - mine[:, np.newaxis]) > SURPRISE
        hit = state.line[:, HIT, self.body - 1 : self.body + 1]
        struck = lines.line[:, HIT, self.body - 1 : self.body + 1].reshape(state.n, -1, 2) != hit[:, np.newaxis]
        wrong = (far & pieces[:, np.newaxis, :, :P_INTENT]).any(axis=(2, 3)) | struck.any(axis=2)
        return np.asarray(~wrong)

    def told(self, state: State, news: Floats) -> Floats:
        """Return what a state's messages say of all bodies, [n, N + 1, PIECES - 1]: all quantities but the intent.

        ``news``: as ``received`` returns it. A place is the distance (m) from this vehicle.
        """
        car = state.car[:, [BRAKING, OWN_LATENCY, MASS]].copy()
        car[:, :, 0] = 0.0
        own = news[:, PLACE, self.body, np.newaxis]
        sample = np.stack([news[:, PLACE] - own, news[:, SAMPLE_SPEED], news[:, SAMPLE_FORCE]], axis=1)
        return np.concatenate([sample, car], axis=1).transpose(0, 2, 1)

    def overwritten(self, state: State, lines: State) -> State:
        """Return ``lines`` [n] with received values in place of assumed ones; ``state`` [n] is the truth now.

        A received place and speed are moved on to the present by the sender's script, without contact. A sender that
        was not accelerating reacts no earlier than at that time. A vehicle with an unknown place keeps its distance to
        this vehicle, within the order of the line. This vehicle measures its own motion and its own impacts.
        """
        body, (pieces, news), time = self.body, self.received(state), state.time_s[:, np.newaxis]
        line, car = lines.line.copy(), lines.car.copy()
        for row, piece in TOLD.items():
            car[:, row, 1:] = np.where(pieces[:, 1:, piece], state.car[:, row, 1:], car[:, row, 1:])
        known, acts = np.asarray(pieces[:, :, [P_PLACE, P_SPEED]].all(axis=2)), pieces[:, :, P_ACCELERATION]
        known[:, 0] = False
        at = np.where(known, news[:, AT], 0.0)
        late = np.maximum(np.maximum(car[:, OWN_LATENCY], np.resize(self.news_s, car[:, LATENCY].shape)), at)
        late = np.where(known & acts & (news[:, SAMPLE_FORCE] != 0.0), at, np.where(known, late, car[:, LATENCY]))
        car[:, LATENCY], car[:, LATENCY, body] = late, state.car[:, LATENCY, body]
        wanted = self.commands(car, state.wanted)
        speed, way = np.where(known, news[:, SAMPLE_SPEED], line[:, SPEED]), np.zeros(known.shape)
        move_on(speed, way, wanted, late - at, car[:, LIMIT], np.where(known, time - at, 0.0))
        line[:, SPEED] = speed
        place = np.zeros(known.shape)
        place[:, 2:] = -np.cumsum(line[:, GAP, 1:-1], axis=1)
        place = np.where(known, news[:, PLACE] + way - news[:, PLACE, [body]], place - place[:, [body]])
        ahead = np.where(pieces[:, 0, P_PLACE], news[:, PLACE, 0] - news[:, PLACE, body], line[:, GAP, 0] + place[:, 1])
        place[:, body:0:-1] = in_order(place[:, body:0:-1], known[:, body:0:-1])
        place[:, body:] = -in_order(-place[:, body:], known[:, body:])
        fresh = known & (at >= time)
        exact = fresh[:, 1:-1] & fresh[:, 2:]
        line[:, GAP, 1:-1] = np.where(exact, state.gaps_m, np.maximum(place[:, 1:-1] - place[:, 2:], 0.0))
        line[:, GAP, 0] = state.line[:, GAP, 0] if body == 1 else np.maximum(ahead - place[:, 1], 0.0)
        force = np.where((late <= 0.0) | (late < time), wanted, 0.0)
        line[:, FORCE] = np.where(fresh & acts, news[:, SAMPLE_FORCE], np.where(known, force, line[:, FORCE]))
        line[:, FORCE, body] = state.line[:, FORCE, body]
        line[:, OF_IMPACTS, body - 1 : body + 1] = state.line[:, OF_IMPACTS, body - 1 : body + 1]
        if body > 1:
            line[:, HIT, 0] = np.where(pieces[:, 1, P_PLACE], news[:, OBSTACLE_HIT, 1], line[:, HIT, 0])
        return lines._replace(line=line, car=car, wanted=wanted)


def without_channel(game: Game, lines: State) -> tuple[Game, State]:
    """Return the game and estimated lines in which every vehicle knows everything, for agents that drive there.

    An estimated line does not say when the truth would be received, so each vehicle's own latency ends when it reacts.
    """
    car = lines.car.copy()
    car[:, OWN_LATENCY] = car[:, LATENCY]
    memories = {name: memory for name, memory in lines.memories.items() if name != NAME}
    return Game._make(game), lines._replace(car=car, know=np.zeros_like(lines.know), memories=memories)


def in_order(place: Floats, known: Bools) -> Floats:
    """Return places (m), [n, vehicles], raised where they would decrease from one vehicle to the next.

    An unknown place is first lowered to the next ``known`` one, if it is beyond it.
    """
    limit = np.where(known, place, np.inf)[:, ::-1]
    within = np.minimum(place, np.minimum.accumulate(limit, axis=1)[:, ::-1])
    return np.maximum.accumulate(within, axis=1)


@large
def move_on(speed, way, wanted, onset, limit, age):
    """Move vehicles on by ``age`` (s) without contact: from ``onset`` (s) on they accelerate with ``wanted`` (m/s2).

    All arrays are [n, N + 1]; ``speed`` (m/s, at most ``limit``) and ``way`` (m) are overwritten.
    """
    for k in range(speed.shape[0]):
        for i in range(speed.shape[1]):
            if age[k, i] > 0.0:
                speed[k, i], way[k, i], _ = solo(
                    max(speed[k, i], 0.0), wanted[k, i], onset[k, i], limit[k, i], age[k, i]
                )
