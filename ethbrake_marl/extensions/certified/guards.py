"""Guards of the modes that certify what is not known: an uncertainty, or a world that is estimated from messages."""

from __future__ import annotations

import copy
from enum import IntEnum
from typing import Any

import numpy as np

from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.extensions.certified.estimated_shield import BelievedShield
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.shield.contract import Guarded, ShieldGuard, why
from ethbrake_marl.shield.guard import StepGuard


class RobustMode(IntEnum):
    """The code ``shield_mode`` of mode ``robust`` in the infos, beside ``eb.ShieldMode``."""

    ROBUST = 2


class RobustGuard(StepGuard):
    """Mode ``robust``: a ``StepGuard`` around a ``RobustShield``."""

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """What the infos say of a certified step, and in how many worlds for each one it is certified."""
        return super().tell(memory, ruling) | {"members": memory.shield.memory.running.members}


class BelievedGuard(ShieldGuard):
    """Modes ``step`` and ``robust`` on what was received: a ``BelievedShield`` that is shown the engine's worlds.

    Its bound is known once the first decision is made, and holds in the estimated world. What happens is not compared
    with the forecast: an estimate may be wrong without anybody's fault.
    """

    def _started(self, shield: BelievedShield, alert: Worlds, rows: Ints) -> BelievedShield:
        shield.begin(alert, rows)
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Apply what is certified in the estimated worlds."""
        worlds = running.worlds
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        after = copy.copy(memory.shield)
        before, proposer = after.interventions, self._proposer(memories, worlds)
        applied = after.decide(worlds, proposed[:, 0], proposer, only=~running.ended)[:, np.newaxis]
        stepped_in = after.interventions > before
        return Ruling(proposed, applied, stepped_in, ~running.ended, after.decision, Guarded(after, memories))

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """What the infos say of a step that is certified in the estimated worlds.

        ``trusted``: something is promised of the real world.
        """
        estimated: BelievedShield = memory.shield
        robust, shield = estimated.robust is not None, estimated.shield
        infos = self._of_step(ruling) | why(ruling)
        infos |= {"bound_harm": np.inf, "settles": False, "believed": True, "trusted": robust}
        if ruling is not None:
            infos["bound_harm"] = np.where(np.isfinite(estimated.predicted_harm), shield.bound, np.inf)
            infos["settles"] = shield.memory.settles
        if robust:
            infos["members"] = estimated.members
        return infos
