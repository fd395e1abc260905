"""``Tape``: the steps of a batch of episodes as they are driven, and every impact in them."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.game.impacts import EpisodeImpacts, impacts_within
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds


class Tape:
    """Records what it sees (``Watch``). With ``steps`` False only the impacts are kept."""

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds  # at the alert
        self.steps: list[tuple[Worlds, Floats, Floats]] = []  # before, commands [n, N], until [n]
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # an impact at the very alert
        self._rows.append(impacts_within(before, command_mps2, until_s, some))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def episodes(self) -> EpisodeImpacts:
        """Every impact so far."""
        return EpisodeImpacts.of(self.worlds.take(np.arange(self.worlds.n)), self._rows)
