"""The paper's own sum of harm: the same commands told in its fixed-step map, harm counted at every sample.

The paper minimises ``J = sum over n of J_harm,n`` (its eq. total_objective and Jharmn): at every sample
``tau_2 + n dt`` each pair with a gap <= 0 adds its squared closing speed. In the exact physics vehicles in resting
contact close with 0 m/s, and pushing does no harm. In the map the pushing vehicle gains ``(u_2 - u_1) dt`` on the
pushed one within each step, and the sum counts it at every sample. The repairs of the printed formulas are those of
``physics.sampled``: only a positive closing speed counts, and the front impact closes with the speed that the rear
impact has changed.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Floats, Worlds, advance_sampled
from ethbrake_marl.physics.obstacle import obstacle_ahead
from ethbrake_marl.scenario import Scenario

VEHICLE_2 = 1  # the map's samples begin with its latency


class SampledHarm:
    """Watches episodes and replays their commands, step by step, through ``advance_sampled`` at the time step.

    Each world goes to the horizon; after the end of its exact episode the last commands are held. The agent decided on
    the exact motion; nobody decides anew. See ``of`` for whom it exists.
    """

    def __init__(self, worlds: Worlds, scenario: Scenario) -> None:
        self._worlds = worlds
        self._command = np.zeros(worlds.speeds_mps.shape)
        self._harm = np.zeros(worlds.n)
        self._start_s = worlds.vehicles.latency_s[:, VEHICLE_2]
        self._step_s, self._horizon_s = scenario.time_step_s, scenario.horizon_s
        self._samples = -1  # steps of the map so far; the time before its first sample is the first

    @classmethod
    def of(cls, worlds: Worlds, scenario: Scenario, driven: tuple[int, ...]) -> SampledHarm | None:
        """What watches these worlds (at the alert); None with an obstacle, or if not just Vehicle 2 is driven.

        The map knows no obstacle, and its samples are the decisions of Vehicle 2.
        """
        return None if driven != (VEHICLE_2,) or obstacle_ahead(worlds).any() else cls(worlds, scenario)

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Replay one step; the commands of a world whose episode has ended stay what they were."""
        running = until_s > before.time_s
        self._command = np.where(running[:, np.newaxis] | (self._samples < 0), command_mps2, self._command)
        self._move()

    def _move(self) -> None:
        """Go on by one step: every world to its next sample, none beyond its first one at or after the horizon."""
        self._samples += 1
        next_s = np.minimum(self._start_s + self._samples * self._step_s, self._horizon_s)
        until_s = np.maximum(next_s, self._worlds.time_s)
        self._worlds, impacts = advance_sampled(self._worlds, self._command, until_s=until_s, step_s=self._step_s)
        self._harm += impacts.total_harm.sum(axis=1)

    def finish(self) -> Floats:
        """Go on to the horizon; gives the sum of each world, [n] m2/s2."""
        while (self._worlds.time_s < self._horizon_s - 1e-6 * self._step_s).any():
            self._move()
        return self._harm
