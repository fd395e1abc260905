"""The exact motion of whole episodes, at every moment."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ethbrake_marl.agents.driving import Episodes, episode_engine
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.evaluation.impacts import Tape
from ethbrake_marl.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.physics.trace import segment_pieces
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.paper_hybrid import HybridAgent

_SAME = 1e-9  # tolerance (m, m/s) within which a piece continues the piece before it, so both are joined

_SHORT_S = 1e-4  # time (s) within which the pieces of a cascade of tiny bounces are joined


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """Motion of one world from the alert to the end of its episode, driven by one agent."""

    world: Worlds  # the world at the alert, n = 1
    # k pieces of cubic motion, [k, 1 + 4 N]: at the beginning of each, time (s), position of Vehicle 1 (m), gaps,
    # speeds, accelerations and jerks
    pieces: Floats
    end_s: float  # time at which the episode ends
    impacts: ImpactRows  # impacts in order of time; world is 0
    stepped_in_s: Floats  # times of the decisions in which a shield replaced the proposed action
    ledger: Ledger  # harm of the episode, n = 1
    final: Worlds  # the world at the end of the episode, n = 1
    at_rest: bool  # whether the line came to rest before the horizon

    @property
    def harm(self) -> tuple[float, float]:
        """Harm of the line (m2/s2): first-impact harm and total harm."""
        first, total = (float(self.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        return first, total


def follow_episodes(worlds: Worlds, agent: Driver, scenario: Scenario) -> list[EpisodeMotion]:
    """Let an agent drive the scenario's learners through every world, as ``evaluate`` does, and return every motion.

    Args:
        worlds: worlds at the alert.
        agent: agent for each learner, or a team; it is not changed.
        scenario: scenario of the worlds, whose scripts drive the other vehicles.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.

    """
    team = Team.of(agent, scenario.learners)
    engine = episode_engine(worlds, team, scenario)
    follower = _Follower(worlds, team, engine)
    episodes = Episodes.of(engine, worlds, [follower])
    return follower.motions(episodes)


class _Follower(Tape):
    """Watcher that records the steps, and the decisions in which a shield replaced an action."""

    def __init__(self, worlds: Worlds, team: Team, engine: Engine) -> None:
        super().__init__(worlds)
        self._hybrids = {i for i, driver in team.drivers.items() if isinstance(driver, HybridAgent)}
        self._first_s = worlds.first_decision_s(list(team.drivers))
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._engine, self._ruling = engine, engine.ruling

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Record one step."""
        super().see(before, command_mps2, until_s)
        ruling = self._engine.ruling
        if ruling is not None and ruling is not self._ruling:  # ``see`` may be called several times in a step
            for k in np.flatnonzero(ruling.stepped_in & ruling.asked).tolist():
                self._stepped_in[k].append(float(before.time_s[k]))
            self._ruling = ruling

    def motions(self, episodes: Episodes) -> list[EpisodeMotion]:
        """Return the recorded motion of each world."""
        n, N = self.worlds.n, self.worlds.N
        impacts, pieces = self.impacts(), self._pieces()
        ends = np.searchsorted(impacts.world, np.arange(n + 1))
        found = []
        for k in range(n):
            mine = slice(*ends[k : k + 2])
            rows = ImpactRows(*(getattr(impacts, f.name)[mine] for f in fields(ImpactRows)))
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
                    replace(rows, world=np.zeros_like(rows.world)),
                    np.array(sorted(taken_over)),
                    ledger,
                    final,
                    bool(episodes.at_rest[k]),
                )
            )
        return found

    def _pieces(self) -> list[Floats]:
        """Return the pieces of each world's motion in order of time; a single piece where the episode ends at once."""
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
    """Join pieces that continue the piece before; of several pieces within ``_SHORT_S``, keep the last."""
    last_of_many = np.append(np.diff(np.floor(pieces[:, 0] / _SHORT_S)) > 0.0, True)
    last_of_many[0] = True
    kept: list[Floats] = []
    for row in pieces[last_of_many]:
        if not kept or not (np.abs(state_at(kept[-1], row[0], vehicles) - row[1:]) <= _SAME).all():
            kept.append(row)
    return np.array(kept)


def state_at(piece: Floats, time_s: float, vehicles: int) -> Floats:
    """Return the state [4 N] at a time within a piece [1 + 4 N].

    The state is the position of Vehicle 1, gaps, speeds, accelerations and jerks.
    """
    t, N = time_s - piece[0], vehicles
    speeds, rates, jerks = (piece[1 + part * N : 1 + (part + 1) * N] for part in (1, 2, 3))
    way = (speeds + 0.5 * (rates + jerks * t / 3.0) * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    after = speeds + (rates + 0.5 * jerks * t) * t
    return np.concatenate([[piece[1] + way[0]], gaps, after, rates + jerks * t, jerks])
