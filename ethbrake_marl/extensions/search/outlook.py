"""Settings that the searching agents ``best_harm`` and ``+search`` share, and the plan that they follow."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from ethbrake_marl.extensions.search.problem import minimising
from ethbrake_marl.first_edition.engine.memory import Memory
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, profile_problem
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.objectives import Declared
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.state import Floats, Worlds

MOST_CANDIDATES = 1_000_000  # most candidates per world


class Outlook(NamedTuple):
    """Settings of an agent that searches for commands, with methods that read the agent's plan."""

    harm_count: HarmCount  # harm count to minimise: ``first`` or ``total``
    horizon_s: float  # end of the simulated episode, s
    time_step_s: float  # time between two decisions, s
    objective: Declared = "total"  # objective to minimise, as a scenario declares it

    @property
    def decisions(self) -> int:
        """Largest possible number of decisions in an episode."""
        return int(np.ceil(self.horizon_s / self.time_step_s)) + 1

    def problem(self, worlds: Worlds, vehicle: int, others_mps2: Floats) -> ProfileProblem:
        """Return the problem of a search for the best commands of ``vehicle`` from the present time to the horizon.

        ``worlds`` are in their present state; ``others_mps2`` [n, N] are the commands of the other vehicles.
        """
        problem = profile_problem(
            worlds, [vehicle], harm_count=self.harm_count, horizon_s=self.horizon_s, time_step_s=self.time_step_s,
            others_mps2=others_mps2,
        )  # fmt: skip
        return minimising(problem, worlds, self.objective, [vehicle])

    def command(self, worlds: Worlds, memory: Memory) -> Floats:
        """Return the command of the agent's plan for the present time of each world, [n] m/s2.

        ``memory`` has ``commands_mps2`` [n, decisions], one command for each decision, and ``start_s`` [n], the time of
        the first decision, s.
        """
        step = Decisions(memory["start_s"], self.time_step_s).latest(worlds.time_s)
        now: Floats = memory["commands_mps2"][np.arange(worlds.n), np.clip(step, 0, self.decisions - 1)]
        return now


def budget_of(argument: str) -> int | None:
    """Convert ``argument`` to a number; return None if it is no whole number from 1 to ``MOST_CANDIDATES``."""
    number = int(argument) if re.fullmatch("[0-9]{1,7}", argument) else 0
    return number if 1 <= number <= MOST_CANDIDATES else None
