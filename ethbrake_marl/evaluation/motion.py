"""The motion of whole episodes, exact at every moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.driving import Episodes, episode_engine
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.evaluation.tape import Tape
from ethbrake_marl.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.physics.trace import segment_pieces
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.paper_hybrid import HybridAgent

_SAME = 1e-9  # m, m/s: a piece that goes on like the one before it is part of it

_SHORT_S = 1e-4  # pieces of a cascade of tiny bounces may be shorter; they are not told apart


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """One world from the alert to the end of its episode, driven by one agent."""

    world: Worlds  # n = 1, at the alert
    # [k, 1 + 4 N] time (s), place of Vehicle 1 (m), gaps, speeds, accelerations and jerks where each begins
    pieces: Floats
    end_s: float
    impacts: ImpactRows  # in order of time; world is 0
    stepped_in_s: Floats  # beginnings of the decisions in which a shield replaced what was proposed
    ledger: Ledger  # n = 1
    final: Worlds  # n = 1, as the episode left it
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    @property
    def harm(self) -> tuple[float, float]:
        """Harm of the line, by first impacts and in total (m2/s2)."""
        first, total = (float(self.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        return first, total


def follow_episodes(worlds: Worlds, agent: Driver, scenario: Scenario) -> list[EpisodeMotion]:
    """Let an agent drive the scenario's learners through every world, as ``evaluate`` does, and keep every motion.

    Args:
        worlds: at the alert.
        agent: drives each learner, or, as a team, its vehicles; it is left as it is.
        scenario: of the worlds; its scripts drive the other vehicles.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.

    """
    team = Team.of(agent, scenario.learners)
    engine = episode_engine(worlds, team, scenario)
    follower = _Follower(worlds, team, engine)
    episodes = Episodes.of(engine, worlds, [follower])
    return follower.motions(episodes)


class _Follower(Tape):
    """Keeps the steps, and in which decisions a shield stepped in."""

    def __init__(self, worlds: Worlds, team: Team, engine: Engine) -> None:
        super().__init__(worlds)
        self._hybrids = {i for i, driver in team.drivers.items() if isinstance(driver, HybridAgent)}
        self._first_s = worlds.first_decision_s(list(team.drivers))
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._engine, self._ruling = engine, engine.ruling

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        super().see(before, command_mps2, until_s)
        ruling = self._engine.ruling
        if ruling is not None and ruling is not self._ruling:  # a step is shown in parts
            for k in np.flatnonzero(ruling.stepped_in & ruling.asked).tolist():
                self._stepped_in[k].append(float(before.time_s[k]))
            self._ruling = ruling

    def motions(self, episodes: Episodes) -> list[EpisodeMotion]:
        """What was seen, world by world."""
        n, N = self.worlds.n, self.worlds.N
        impacts, pieces = self.episodes(), self._pieces()
        found = []
        for k in range(n):
            ledger = episodes.ledger.take([k])
            final, taken_over = episodes.final.take([k]), list(self._stepped_in[k])
            chosen = [memory["chosen_policy"][k] for i, memory in episodes.memories.items() if i in self._hybrids]
            if not all(chosen):
                taken_over.append(float(self._first_s[k]))
            found.append(
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
        return found

    def _pieces(self) -> list[Floats]:
        """The pieces of each world's motion, one after the other; one piece where it ends at once."""
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
    """The pieces without those that go on like the one before; of many within ``_SHORT_S`` the last one stays."""
    last_of_many = np.append(np.diff(np.floor(pieces[:, 0] / _SHORT_S)) > 0.0, True)
    last_of_many[0] = True
    kept: list[Floats] = []
    for row in pieces[last_of_many]:
        if not kept or not (np.abs(state_at(kept[-1], row[0], vehicles) - row[1:]) <= _SAME).all():
            kept.append(row)
    return np.array(kept)


def state_at(piece: Floats, time_s: float, vehicles: int) -> Floats:
    """Place of Vehicle 1, gaps, speeds, accelerations and jerks [4 N] at a time of a piece [1 + 4 N]."""
    t, N = time_s - piece[0], vehicles
    speeds, rates, jerks = (piece[1 + part * N : 1 + (part + 1) * N] for part in (1, 2, 3))
    way = (speeds + 0.5 * (rates + jerks * t / 3.0) * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    after = speeds + (rates + 0.5 * jerks * t) * t
    return np.concatenate([[piece[1] + way[0]], gaps, after, rates + jerks * t, jerks])
