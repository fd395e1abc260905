"""``Tape``: recorder of all steps and impacts of a batch of episodes."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.game.impacts import EpisodeImpacts, impacts_within
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds


class Tape:
    """Recorder of all impacts, and optionally all time steps, of a batch of episodes. Call ``see`` after each step.

    Args:
        worlds: the n worlds at the alert.
        steps: whether to record every time step in addition to the impacts.

    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds
        # For each step: worlds at its beginning, commands [n, N] (m/s2), time at which the step ends [n] (s).
        self.steps: list[tuple[Worlds, Floats, Floats]] = []
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Record one time step.

        Args:
            before: the worlds at the beginning of the step.
            command_mps2: commanded accelerations during the step (m/s2), [n, N].
            until_s: time since the alert at which the step ends (s), [n]; in a world whose episode has ended, the time
                at which the episode ended.

        """
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # includes impacts at the alert itself
        self._rows.append(impacts_within(before, command_mps2, until_s, some))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def episodes(self) -> EpisodeImpacts:
        """Return all recorded impacts, ordered by world and time, together with the worlds at the alert."""
        return EpisodeImpacts.of(self.worlds.take(np.arange(self.worlds.n)), self._rows)
