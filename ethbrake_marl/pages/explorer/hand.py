"""A profile that somebody draws: commands of one vehicle on the grid of decisions, and the agent that drives it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.pages.explorer.state import read_number
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import decision_at, first_decision_s, number_of_decisions
from ethbrake_marl.scenario import Scenario

MOST_COMMANDS = 2_000


class Grid(NamedTuple):
    """Where the commands of a profile fall, and which are possible."""

    first_s: float
    step_s: float
    steps: int
    low_mps2: float
    high_mps2: float


def decision_grid(world: Worlds, scenario: Scenario, vehicle: int) -> Grid:
    """The decisions of a vehicle in one world (n = 1)."""
    first = first_decision_s(world, [vehicle])
    steps = int(number_of_decisions(first, scenario.time_step_s, scenario.horizon_s)[0])
    v = world.vehicles
    low, high = -float(v.braking_capacity_mps2[0, vehicle]), float(v.driving_capacity_mps2[0, vehicle])
    return Grid(float(first[0]), scenario.time_step_s, steps, low, high)


def read_profile(given: object) -> Floats:
    """Commands (m/s2) that a page sends, one per decision; raises ``InvalidInput``."""
    if not isinstance(given, list) or not 1 <= len(given) <= MOST_COMMANDS:
        raise InvalidInput(f"profile: must be a list of 1 to {MOST_COMMANDS} commands in m/s2")
    return np.array([read_number(value, f"profile[{k}]") for k, value in enumerate(given)])


class HandDriven:
    """Drives a profile in every world; the last command goes on, and one beyond a capacity asks for the capacity."""

    knows = Source.UNSTATED

    def __init__(self, commands_mps2: Floats, time_step_s: float, name: str = "by hand") -> None:
        self.name = name
        self.commands_mps2 = commands_mps2
        self._time_step_s = time_step_s
        self._start_s: Floats = np.empty(0)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Note when the decisions of these episodes fall."""
        self._start_s = first_decision_s(worlds, [vehicle])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of the decision at hand, [n] m/s2."""
        step = decision_at(worlds.time_s, self._start_s[: worlds.n], self._time_step_s)
        command = self.commands_mps2[np.clip(step, 0, len(self.commands_mps2) - 1)]
        v = worlds.vehicles
        bounded: Floats = np.clip(command, -v.braking_capacity_mps2[:, vehicle], v.driving_capacity_mps2[:, vehicle])
        return bounded
