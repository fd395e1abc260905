"""An agent that drives the best profile known: one kept beforehand where there is one, else searched at the alert."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import fixed_commands, place
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, count_of, renumbered
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.episode import START, decision_at
from ethbrake_marl.search.kernel import MOST_PHASES
from ethbrake_marl.search.problem import TIME_STEP_S, ProfileProblem, profile_problem
from ethbrake_marl.search.profiles import Profiles, constant_profiles, follow_profiles, pad_profiles, search_profiles

SEARCH_BUDGET = 20_000  # candidates in a world of which nothing is known

Recall = Callable[[ProfileProblem, HarmCount], tuple[Profiles, Bools]]
"""Kept profiles [n] of a problem, and where there is one [n]; the others are ignored."""


class BestHarm:
    """Drives the profile of least harm known, while the ``others`` follow their scripts (without one: brake fully).

    ``recall`` gives the kept profiles; a world without one is searched at the alert with ``budget`` candidates.
    Decisions fall every ``time_step_s`` from the vehicle's latency on. ``predicted_harm`` [n] is what the engine will
    count (m2/s2), to the same bits, if the engine's time step is that. Raises ``InvalidInput`` for a budget below 1 or
    an unknown count and, when an episode begins, for another vehicle's script whose command is not fixed at the alert.
    """

    knows = Source.MODEL

    def __init__(
        self,
        recall: Recall,
        *,
        harm_count: HarmCount = "first",
        horizon_s: float = 8.0,
        budget: int = SEARCH_BUDGET,
        time_step_s: float = TIME_STEP_S,
    ) -> None:
        if not budget >= 1:
            raise InvalidInput(f"best_harm: budget = {budget}; at least 1 candidate is needed")
        check_harm_count(harm_count)
        self.name = "best_harm"
        self.others: Mapping[int, Script] = {}
        self.predicted_harm: Floats = np.empty(0)
        self.searched: Floats = np.empty(0)  # [n] 1 where nothing was kept
        self._recall = recall
        self._harm_count: HarmCount = harm_count
        self._horizon_s, self._time_step_s = horizon_s, time_step_s
        self._budget = budget
        self._start_s: Floats = np.empty(0)
        self._profiles = Profiles(np.zeros((0, 1), np.int64), np.zeros((0, 1, 1)))

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Look these rows' worlds up, and search those that are not known."""
        others = fixed_commands(self.others, worlds, f"agent {self.name!r}", vehicle=vehicle)
        problem = self._problem(worlds, vehicle, others)
        profiles, known = self._recall(problem, self._harm_count)
        unknown = np.flatnonzero(~known)
        if unknown.size:
            profiles = self._search(worlds, vehicle, others, profiles, unknown)
        first, total = follow_profiles(problem, profiles)
        self.predicted_harm = place(self.predicted_harm, rows, first if self._harm_count == "first" else total)
        self.searched = place(self.searched, rows, (~known).astype(np.float64))
        self._start_s = place(self._start_s, rows, problem.clock[:, START])
        self._profiles = _place(self._profiles, rows, profiles, self._start_s.size)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of the phase in force, [n] m/s2. Raises ``InvalidInput`` if an episode never began."""
        if worlds.n > len(self._start_s) or np.isnan(self._start_s[: worlds.n]).any():
            raise InvalidInput(
                f"agent {self.name!r}: act on {count_of(worlds.n, 'world')}, but begin was not called for each"
            )
        step = np.maximum(decision_at(worlds.time_s, self._start_s[: worlds.n], self._time_step_s), 0)
        return self._profiles.take(slice(worlds.n)).at(step)[:, 0]

    def _problem(self, worlds: Worlds, vehicle: int, others: Floats) -> ProfileProblem:
        return profile_problem(
            worlds, [vehicle], harm_count=self._harm_count, horizon_s=self._horizon_s, time_step_s=self._time_step_s,
            others_mps2=others,
        )  # fmt: skip

    def _search(self, worlds: Worlds, vehicle: int, others: Floats, profiles: Profiles, unknown: Ints) -> Profiles:
        """The given profiles with those of ``unknown`` worlds replaced by searched ones."""
        part, theirs = worlds.take(unknown), others[unknown]
        problem = self._problem(part, vehicle, theirs)
        horizon_s, harm_count = self._horizon_s, self._harm_count
        with renumbered(unknown):
            coupled = optimise_coupled(part, vehicle, harm_count=harm_count, horizon_s=horizon_s, others_mps2=theirs)
            given = constant_profiles(problem, -coupled.deceleration_mps2[:, np.newaxis, np.newaxis])
            found = search_profiles(problem, given, budget=self._budget).profiles
        whole, found = pad_profiles([profiles, found], MOST_PHASES)
        whole.ends[unknown] = found.ends
        whole.commands_mps2[unknown] = found.commands_mps2
        return whole


def _place(stored: Profiles, rows: Ints, profiles: Profiles, n: int) -> Profiles:
    """The stored profiles, now of ``n`` rows, with those of ``rows`` replaced."""
    stored, profiles = pad_profiles([stored, profiles], 1)
    grown = stored.grown(n)
    grown.ends[rows] = profiles.ends
    grown.commands_mps2[rows] = profiles.commands_mps2
    return grown
