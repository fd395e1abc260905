"""Running episodes at a decision: the state from which a shield simulates plans."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.first_edition.engine.profiles import ProfileProblem
from ethbrake_marl.first_edition.physics.episode import CLOCK, Decisions
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints


class Running(NamedTuple):
    """Running episodes at a decision: n worlds with M possible worlds (*members*) each. Usually M is 1.

    The possible worlds of world k are in rows k * M to k * M + M - 1. Row k * M contains world k itself, the *nominal*
    world. For K shielded vehicles, actions have the shape [n, K] and plans (one action for each of L decisions) the
    shape [n, L, K]. For a single shielded vehicle, actions and plans may lack the axis K.
    """

    problem: ProfileProblem  # parameters, commands of unshielded vehicles and times of the decisions, in n * M rows
    states: Floats  # [n * M, S] speeds, gaps, hit flags, harms, forces; in the layout of ``physics.episode.save``
    steps: Ints  # [n] number of the present decision, from 0
    ended: Bools  # [n * M] whether the episode is over
    caps: Floats = np.zeros((0, 0))  # [n * M, N] cap of each vehicle (m2/s2); [0, 0]: no caps

    @property
    def uncapped(self) -> Running:
        """The episodes without ``caps``."""
        return self._replace(caps=np.zeros((0, 0)))

    @property
    def n(self) -> int:
        """Number n of worlds; a world with several possible worlds counts once."""
        return len(self.steps)

    @property
    def members(self) -> int:
        """Number M of possible worlds of each world."""
        return len(self.ended) // max(self.n, 1)

    @property
    def finished(self) -> Bools:
        """For each world: whether the episode has ended in all possible worlds of the world, [n]."""
        return np.asarray(self.ended.reshape(self.n, -1).all(axis=1), np.bool_)

    @property
    def time_s(self) -> Floats:
        """Time of the present decision of each world since the alert, [n] s."""
        clock = self.problem.clock[:: self.members]
        return Decisions(clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP]).at(self.steps)

    def rows_of(self, worlds: Ints) -> Ints:
        """Return the row indices of all possible worlds of the worlds with indices ``worlds``, [len(worlds) * M]."""
        return np.asarray((worlds[:, np.newaxis] * self.members + np.arange(self.members)).ravel(), np.int64)

    def take(self, worlds: Ints) -> Running:
        """Return only the episodes of the worlds with indices ``worlds``, with all their possible worlds."""
        return self._select(self.rows_of(worlds), worlds)

    def nominal(self) -> Running:
        """Return the episodes with only one possible world for each world: the world itself."""
        if self.members == 1:
            return self
        return self._select(np.arange(self.n) * self.members, np.arange(self.n))

    def _select(self, rows: Ints, worlds: Ints) -> Running:
        caps = self.caps[rows] if self.caps.size else self.caps
        return Running(self.problem.take(rows), self.states[rows], self.steps[worlds], self.ended[rows], caps)


def begin_running(problem: ProfileProblem, members: int = 1) -> Running:
    """Return running episodes in the worlds of ``problem``, at their first decision.

    ``problem`` contains the states of the worlds at the first decision, and the commands of the unshielded vehicles.
    Each ``members`` consecutive rows of ``problem`` are the possible worlds of one world.
    """
    steps, ended = np.zeros(problem.n // members, np.int64), np.zeros(problem.n, np.bool_)
    return Running(problem, problem.start, steps, ended)


Number = TypeVar("Number", bound=np.generic)


def put(old: NDArray[Number], rows: Ints, new: NDArray[Number]) -> NDArray[Number]:
    """Return a copy of ``old`` in which row ``rows[j]`` is replaced by row j of ``new``."""
    placed = old.copy()
    placed[rows] = new
    return placed
