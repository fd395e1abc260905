"""Running episodes at a decision, as a shield knows them: the state that it certifies from."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine.profiles import ProfileProblem
from ethbrake_marl.physics.episode import CLOCK, Decisions
from ethbrake_marl.physics.state import Bools, Floats, Ints


class Running(NamedTuple):
    """Running episodes at a decision: n worlds with M members each; M is 1 unless possible worlds are given.

    The members of world k are the rows k * M to k * M + M - 1, the nominal one first. Of several shielded vehicles,
    proposals and actions are [n, K], and plans [n, L, K]. Of one they are [n] and [n, L], or [n, 1] and [n, L, 1].
    """

    problem: ProfileProblem  # parameters, commands of the others, grid of decisions; K vehicles; n * M rows
    states: Floats  # [n * M, S] as ``physics.episode.save`` leaves them: speeds, gaps, hit flags, harms so far, forces
    steps: Ints  # [n] number of the decision
    ended: Bools  # [n * M]
    caps: Floats = np.zeros((0, 0))  # [n * M, N] most harm that each vehicle may bear (m2/s2); [0, 0]: any

    @property
    def uncapped(self) -> Running:
        """The same episodes without caps."""
        return self._replace(caps=np.zeros((0, 0)))

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.steps)

    @property
    def members(self) -> int:
        """Number of members of each world (M)."""
        return len(self.ended) // max(self.n, 1)

    @property
    def finished(self) -> Bools:
        """Worlds in which every member's episode is over, [n]."""
        return np.asarray(self.ended.reshape(self.n, -1).all(axis=1), np.bool_)

    @property
    def time_s(self) -> Floats:
        """Time of the decision in the nominal member, [n] s."""
        clock = self.problem.clock[:: self.members]
        return Decisions(clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP]).at(self.steps)

    def rows_of(self, worlds: Ints) -> Ints:
        """The rows of the members of some worlds."""
        return np.asarray((worlds[:, np.newaxis] * self.members + np.arange(self.members)).ravel(), np.int64)

    def take(self, worlds: Ints) -> Running:
        """Some of the worlds, with all their members."""
        return self._select(self.rows_of(worlds), worlds)

    def nominal(self) -> Running:
        """Every world with its nominal member alone."""
        if self.members == 1:
            return self
        return self._select(np.arange(self.n) * self.members, np.arange(self.n))

    def _select(self, rows: Ints, worlds: Ints) -> Running:
        caps = self.caps[rows] if self.caps.size else self.caps
        return Running(self.problem.take(rows), self.states[rows], self.steps[worlds], self.ended[rows], caps)


def begin_running(problem: ProfileProblem, members: int = 1) -> Running:
    """The episodes of a problem at their first decision; its rows are worlds with ``members`` each."""
    steps, ended = np.zeros(problem.n // members, np.int64), np.zeros(problem.n, np.bool_)
    return Running(problem, problem.start, steps, ended)


Number = TypeVar("Number", bound=np.generic)


def put(old: NDArray[Number], rows: Ints, new: NDArray[Number]) -> NDArray[Number]:
    """A copy of ``old`` with ``new`` in these rows."""
    placed = old.copy()
    placed[rows] = new
    return placed
