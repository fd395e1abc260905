"""The recorder of an agent: its commands in each step of its episodes."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.protocol import Agent, AgentAround
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import decision_at, first_decision_s
from ethbrake_marl.scenario import Scenario


def record_commands(agent: Agent, worlds: Worlds, scenario: Scenario, vehicle: int, steps: int) -> Floats:
    """The commands that ``agent`` gives ``vehicle`` in the first ``steps`` decisions of its episodes, [n, steps] m/s2.

    ``worlds`` are at the alert. After an episode's end its last command goes on. Raises ``PhysicsError`` naming the
    worlds that it cannot drive to the end.
    """
    recorder = _Recorder(agent, steps, scenario.time_step_s)
    drive(worlds, recorder, scenario, vehicle)
    commands = recorder.commands_mps2
    latest = np.maximum.accumulate(np.where(np.isnan(commands), 0, np.arange(steps)), axis=1)
    filled: Floats = np.take_along_axis(commands, latest, axis=1)
    return filled


class _Recorder(AgentAround):
    """An agent that drives as another one does and keeps every command."""

    def __init__(self, agent: Agent, steps: int, time_step_s: float) -> None:
        super().__init__(agent)
        self.commands_mps2: Floats = np.empty((0, steps))  # [n, steps], NaN after an episode's end
        self._time_step_s = time_step_s
        self._start_s: Floats = np.empty(0)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """All episodes begin at once here."""
        self._start_s = first_decision_s(worlds, [vehicle])
        self.commands_mps2 = np.full((worlds.n, self.commands_mps2.shape[1]), np.nan)
        super().begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        command = self.policy.act(worlds, vehicle)
        step = decision_at(worlds.time_s, self._start_s, self._time_step_s)
        deciding = np.flatnonzero((step >= 0) & (step < self.commands_mps2.shape[1]))
        self.commands_mps2[deciding, step[deciding]] = command[deciding]
        return command
