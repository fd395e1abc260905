"""``Tape``: recorder of the steps of a batch of episodes, and of every impact in them."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.game.impacts import EpisodeImpacts, impacts_within
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds


class Tape:
    """Recorder of a batch of running episodes; the engine calls ``see`` after each step (protocol ``Watch``).

    Args:
        worlds: the n worlds at the alert.
        steps: also record every step; False: only the impacts.

    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds  # the worlds at the alert
        # Each step: the worlds at its beginning, commands [n, N] in m/s2, time [n] in s at which it ends.
        self.steps: list[tuple[Worlds, Floats, Floats]] = []
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Record one step.

        Args:
            before: the worlds at the beginning of the step.
            command_mps2: [n, N] commanded accelerations during the step.
            until_s: [n] time at which the step ends; equal to the beginning if the world's episode has ended.

        """
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # an impact at the very alert
        self._rows.append(impacts_within(before, command_mps2, until_s, some))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def episodes(self) -> EpisodeImpacts:
        """Return all impacts so far, by world and in order of time, with the worlds at the alert."""
        return EpisodeImpacts.of(self.worlds.take(np.arange(self.worlds.n)), self._rows)
