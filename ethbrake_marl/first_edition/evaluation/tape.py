"""``Tape``: recorder of all steps and impacts of a batch of episodes."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts, impacts_within
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Floats, Worlds


class Tape:
    """Recorder of all impacts and, with ``steps``, of all time steps of a batch of episodes.

    Create the object with the n worlds at the alert, and call ``see`` after each step.
    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds
        # Arguments of ``see`` in each step.
        self.steps: list[tuple[Worlds, Floats, Floats]] = []
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Record one time step, from the worlds ``before`` until ``until_s`` (time since the alert, [n]).

        ``command_mps2`` has the commanded accelerations during the step, [n, N]. In a world whose episode has ended,
        ``until_s`` is the end of the episode.
        """
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # includes impacts at the alert itself
        self._rows.append(impacts_within(before, command_mps2, until_s, some))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def episodes(self) -> EpisodeImpacts:
        """Return all recorded impacts, ordered by world and time, with the worlds at the alert."""
        return EpisodeImpacts.of(self.worlds.take(np.arange(self.worlds.n)), self._rows)
