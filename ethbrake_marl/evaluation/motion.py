"""Whole episodes, exact at every moment: pieces of constant acceleration, impacts, and where a shield stepped in."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.rollout import Episodes, drive
from ethbrake_marl.agents.team import Driver, Team, team_of
from ethbrake_marl.harm import HARM_COUNTS, Ledger
from ethbrake_marl.physics import Floats, ImpactRows, Worlds, advance
from ethbrake_marl.physics.episode import first_decision_s
from ethbrake_marl.physics.pieces import segment_pieces
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.shield.team_agent import shield_around

_SAME = 1e-9  # m, m/s: a piece that goes on like the one before it is part of it
_SHORT_S = 1e-4  # pieces of a cascade of tiny bounces may be shorter; they are not told apart


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """One world from the alert to the end of its episode, driven by one agent."""

    world: Worlds  # n = 1, at the alert
    pieces: Floats  # [k, 1 + N + 2 N] time (s), place of Vehicle 1 (m), gaps, speeds, accelerations where each begins
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
    team = team_of(agent, scenario.learners)
    follower = _Follower(worlds, team)
    episodes = drive(worlds, team, scenario, watched_by=[follower])
    return [follower.motion(k, episodes) for k in range(worlds.n)]


class _Follower:
    """Watches a batch of episodes."""

    def __init__(self, worlds: Worlds, team: Team) -> None:
        self._worlds, self._drivers = worlds, list(team.drivers.values())
        self._first_s = first_decision_s(worlds, list(team.drivers))
        self._way_m = np.zeros(worlds.n)
        self._pieces: list[list[Floats]] = [[] for _ in range(worlds.n)]
        self._impacts: list[list[ImpactRows]] = [[] for _ in range(worlds.n)]
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._count = np.zeros(worlds.n)

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep the pieces and impacts of one step."""
        moving = until_s > before.time_s
        moving |= before.time_s == self._worlds.time_s  # an impact at the very alert
        some = np.flatnonzero(moving)
        rows = advance(before.take(some), command_mps2[some], until_s=until_s[some], record=True)[1].rows
        assert rows is not None  # they were asked for
        columns = [np.zeros_like(rows.world), *(getattr(rows, f.name) for f in fields(ImpactRows)[1:])]
        starts = np.searchsorted(rows.world, np.arange(some.size + 1)).tolist()  # they come world by world
        for k, first, end in zip(some.tolist(), starts[:-1], starts[1:], strict=True):
            self._impacts[k].append(ImpactRows(*(column[first:end] for column in columns)))
        some = np.flatnonzero(until_s > before.time_s)
        for k, pieces in zip(
            some.tolist(), segment_pieces(before.take(some), command_mps2[some], until_s[some]), strict=True
        ):
            way = _way(pieces, float(until_s[k]))
            pieces[:, 1] += self._way_m[k]
            self._pieces[k].append(pieces)
            self._way_m[k] += way
        count = _steps_taken_over(self._drivers, before.n)
        for k in np.flatnonzero(count > self._count).tolist():
            self._stepped_in[k].append(float(before.time_s[k]))
        self._count = count

    def motion(self, k: int, episodes: Episodes) -> EpisodeMotion:
        """What was seen of world ``k``."""
        parts, N = self._impacts[k], self._worlds.N
        impacts = ImpactRows(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(ImpactRows)))
        pieces = np.concatenate(self._pieces[k]) if self._pieces[k] else _standing(self._worlds, k)
        ledger = Ledger(*(getattr(episodes.ledger, f.name)[[k]] for f in fields(Ledger)))
        final = episodes.final.take([k])
        taken_over = list(self._stepped_in[k])
        if any(isinstance(d, HybridAgent) and not d.chosen_policy[k] for d in self._drivers):
            taken_over.append(float(self._first_s[k]))
        return EpisodeMotion(
            self._worlds.take([k]), join_pieces(pieces, N), float(final.time_s[0]), impacts,
            np.array(sorted(taken_over)), ledger, final, bool(episodes.at_rest[k]),
        )  # fmt: skip


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
    """Place of Vehicle 1, gaps, speeds and accelerations [3 N] at a time of a piece [1 + 3 N]."""
    t, N = time_s - piece[0], vehicles
    speeds, accelerations = piece[1 + N : 1 + 2 * N], piece[1 + 2 * N :]
    way = (speeds + 0.5 * accelerations * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    return np.concatenate([[piece[1] + way[0]], gaps, speeds + accelerations * t, accelerations])


def _way(pieces: Floats, until_s: float) -> float:
    """How far Vehicle 1 has come at the end of these pieces."""
    last = pieces[-1]
    vehicles = (len(last) - 1) // 3
    return float(state_at(last, until_s, vehicles)[0])


def _standing(worlds: Worlds, k: int) -> Floats:
    """The one piece of an episode that ends where it begins."""
    N = worlds.N
    return np.concatenate([worlds.time_s[[k]], [0.0], worlds.gaps_m[k], worlds.speeds_mps[k], np.zeros(N)])[np.newaxis]


def _steps_taken_over(drivers: list[Agent], n: int) -> Floats:
    """A count, [n], that rises with every decision in which a step shield applied something else than a proposal."""
    count = np.zeros(n)
    for driver in drivers:
        if (shield := shield_around(driver)) is not None:
            count += shield.interventions
    return count
