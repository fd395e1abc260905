"""E-V2X-BM as an agent: one constant deceleration, chosen at the alert."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ethbrake_marl.agents.coupled import optimise_coupled
from ethbrake_marl.agents.pairwise import optimise_pairwise
from ethbrake_marl.agents.protocol import place, recall
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats, Ints, Worlds

Mode = Literal["coupled", "pairwise"]


class EV2XBM:
    """The constant deceleration of least harm, all other vehicles braking at full capacity.

    ``coupled`` minimises the harm realised in the engine's physics until ``horizon_s`` under the given ``count``;
    ``pairwise`` is the paper's closed form, whose prediction does not hold once velocities are exchanged.
    ``predicted_harm`` [n] is what each of them expects (m2/s2). Raises ``InvalidInput`` for an unknown mode.
    """

    def __init__(self, mode: Mode = "coupled", *, count: HarmCount = "first", horizon_s: float = 8.0) -> None:
        if mode not in ("coupled", "pairwise"):
            raise InvalidInput(f"e_v2x_bm mode {mode!r}: must be 'coupled' or 'pairwise'")
        self.name = "e_v2x_bm" if mode == "coupled" else "e_v2x_bm:pairwise"
        self.predicted_harm: Floats = np.empty(0)
        self.deceleration_mps2: Floats = np.empty(0)  # a* [n]
        self._mode = mode
        self._count = count
        self._horizon_s = horizon_s

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Choose a* for these rows' episodes from their worlds at the alert."""
        if self._mode == "pairwise":
            closed = optimise_pairwise(worlds, vehicle)
            best, harm = closed.deceleration_mps2, closed.harm
        else:
            coupled = optimise_coupled(worlds, vehicle, count=self._count, horizon_s=self._horizon_s)
            best, harm = coupled.deceleration_mps2, coupled.harm
        self.deceleration_mps2 = place(self.deceleration_mps2, rows, best)
        self.predicted_harm = place(self.predicted_harm, rows, harm)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """``-a*``, [n] m/s2."""
        return -recall(self.deceleration_mps2, worlds.n, self.name)
