"""Exact motion of whole episodes as cubic polynomials of time, from which the state at any time is computed.

In this file a *piece* is a stretch of time in which all jerks are constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.first_edition.agents.driving import Episodes, episode_engine
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.evaluation.tape import Tape
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.physics.trace import segment_pieces
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent

_SAME = 1e-9  # two consecutive pieces are joined if the first one, continued, is this close to the second (m, m/s)

_SHORT_S = 1e-4  # pieces that begin within this time (s), for instance during tiny bounces, are joined


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """Exact motion of one world from the alert to the end of its episode, with its impacts and harm."""

    world: Worlds  # the world at the alert, n = 1
    # Motion as k pieces in order of time, [k, 1 + 4 N]. The row of a piece is the state at its beginning: time (s),
    # position of Vehicle 1 (m), gaps (N - 1, m), speeds (N, m/s), accelerations (N, m/s2) and jerks (N, m/s3).
    pieces: Floats
    end_s: float  # time since the alert at which the episode ends (s)
    impacts: ImpactRows  # all impacts in order of time; column ``world`` is 0
    stepped_in_s: Floats  # times (s) of the decisions at which a shield replaced the policy's action, ascending
    ledger: Ledger  # harm of all impacts of the episode, n = 1
    final: Worlds  # the world at the end of the episode, n = 1
    at_rest: bool  # whether the line came to rest before the horizon

    @property
    def harm(self) -> tuple[float, float]:
        """Pair (first-impact harm, total harm) of the whole line, m2/s2."""
        first, total = (float(self.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        return first, total


def follow_episodes(worlds: Worlds, agent: Driver, scenario: Scenario) -> list[EpisodeMotion]:
    """Let an agent or team drive the learners of every world as in ``evaluate``, and return each world's motion.

    Raises ``PhysicsError``, which lists the worlds whose simulation failed.
    """
    team = Team.of(agent, scenario.learners)
    engine = episode_engine(worlds, team, scenario)
    follower = _Follower(worlds, team, engine)
    episodes = Episodes.of(engine, worlds, [follower])
    return follower.motions(episodes)


class _Follower(Tape):
    """Recorder of every time step of episodes, and of the decisions at which a shield replaced the policy's action.

    ``engine.ruling`` says what the shield decided in the current step.
    """

    def __init__(self, worlds: Worlds, team: Team, engine: Engine) -> None:
        super().__init__(worlds)
        self._hybrids = {i for i, driver in team.drivers.items() if isinstance(driver, HybridAgent)}
        self._first_s = worlds.first_decision_s(list(team.drivers))
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._engine, self._ruling = engine, engine.ruling

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Record one time step (``Tape.see``)."""
        super().see(before, command_mps2, until_s)
        ruling = self._engine.ruling
        if ruling is not None and ruling is not self._ruling:  # ``see`` may be called several times in a step
            for k in np.flatnonzero(ruling.stepped_in & ruling.asked).tolist():
                self._stepped_in[k].append(float(before.time_s[k]))
            self._ruling = ruling

    def motions(self, episodes: Episodes) -> list[EpisodeMotion]:
        """Return the recorded motion of each world, with the harm and the final state from ``episodes``."""
        n, N = self.worlds.n, self.worlds.N
        impacts, pieces = self.episodes(), self._pieces()
        motions = []
        for k in range(n):
            ledger = episodes.ledger.take([k])
            final, taken_over = episodes.final.take([k]), list(self._stepped_in[k])
            chosen = [memory["chosen_policy"][k] for i, memory in episodes.memories.items() if i in self._hybrids]
            if not all(chosen):
                taken_over.append(float(self._first_s[k]))
            motions.append(
                EpisodeMotion(
                    self.worlds.take([k]),
                    join_pieces(pieces[k], N),
                    float(final.time_s[0]),
                    impacts.take(np.array([k])).rows,
                    np.array(sorted(taken_over)),
                    ledger,
                    final,
                    bool(episodes.at_rest[k]),
                )
            )
        return motions

    def _pieces(self) -> list[Floats]:
        """Return the pieces of each world (``EpisodeMotion.pieces``); one row if its episode ends at the alert."""
        parts: list[list[Floats]] = [[] for _ in range(self.worlds.n)]
        way_m = np.zeros(self.worlds.n)
        for before, command, until_s in self.steps:
            some = np.flatnonzero(until_s > before.time_s)
            seen = segment_pieces(before.take(some), command[some], until_s[some])
            for k, pieces in zip(some.tolist(), seen, strict=True):
                way = float(state_at(pieces[-1], float(until_s[k]), self.worlds.N)[0])
                pieces[:, 1] += way_m[k]
                parts[k].append(pieces)
                way_m[k] += way
        w = self.worlds
        standing = np.concatenate(
            [w.time_s[:, np.newaxis], np.zeros((w.n, 1)), w.gaps_m, w.speeds_mps, np.zeros((w.n, 2 * w.N))], axis=1
        )
        return [np.concatenate(each) if each else standing[[k]] for k, each in enumerate(parts)]


def join_pieces(pieces: Floats, vehicles: int) -> Floats:
    """Return the same motion (``EpisodeMotion.pieces``) with fewer pieces; ``vehicles`` is the number N.

    A piece is dropped if the previous piece, continued to the beginning of this piece, leads to the same state up to
    rounding. If several pieces begin within the same 0.1 ms, only the last of them is kept.
    """
    last_of_many = np.append(np.diff(np.floor(pieces[:, 0] / _SHORT_S)) > 0.0, True)
    last_of_many[0] = True
    needed: list[Floats] = []
    for row in pieces[last_of_many]:
        if not needed or not (np.abs(state_at(needed[-1], row[0], vehicles) - row[1:]) <= _SAME).all():
            needed.append(row)
    return np.array(needed)


def state_at(piece: Floats, time_s: float, vehicles: int) -> Floats:
    """Return the state [4 N] at ``time_s`` (since the alert) within ``piece``, a row of ``EpisodeMotion.pieces``.

    The state is the position of Vehicle 1 (m), gaps (m), speeds (m/s), accelerations (m/s2) and jerks (m/s3).
    ``vehicles`` is the number N.
    """
    t, N = time_s - piece[0], vehicles
    speeds, rates, jerks = (piece[1 + part * N : 1 + (part + 1) * N] for part in (1, 2, 3))
    way = (speeds + 0.5 * (rates + jerks * t / 3.0) * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    after = speeds + (rates + 0.5 * jerks * t) * t
    return np.concatenate([[piece[1] + way[0]], gaps, after, rates + jerks * t, jerks])
