"""Guards of the shields for incomplete knowledge: modes ``robust`` and ``estimated``.

A *guard* connects a shield with a running engine.
"""

from __future__ import annotations

import copy
from enum import IntEnum
from typing import Any

import numpy as np

from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.extensions.certified.estimated_shield import EstimatedShield
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.shields.contract import Guarded, ShieldGuard, why
from ethbrake_marl.shields.guard import StepGuard


class RobustMode(IntEnum):
    """Number of mode ``robust`` in the info ``shield_mode``; ``eb.ShieldMode`` has the numbers of the other modes."""

    ROBUST = 2


class RobustGuard(StepGuard):
    """Guard of mode ``robust``: in each step of the engine, a ``RobustShield`` decides which actions are applied."""

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos of a step as a mapping. ``members`` is the number of possible worlds that are certified for
        each true world.

        Args:
            memory: shield and policies after the step.
            ruling: decision of the step; None at the reset.

        """
        return super().tell(memory, ruling) | {"members": memory.shield.memory.running.members}


class EstimatedGuard(ShieldGuard):
    """Guard of modes ``step`` and ``robust`` in the estimated world: an ``EstimatedShield`` decides which actions are
    applied.

    Its bound on harm exists from the first decision on and holds in the estimated world. The guard does not compare the
    true motion with the prediction: estimates may be wrong, so a difference is no error.
    """

    def _started(self, shield: EstimatedShield, alert: Worlds, rows: Ints) -> EstimatedShield:
        shield.begin(alert, rows)
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Return the proposed actions and the actions to apply, which are certified in the estimated worlds.

        Args:
            running: the engine before the step.
            memory: shield and policies before the step.
            proposed: [n, 1] proposed actions.

        """
        worlds = running.worlds
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        after = copy.copy(memory.shield)
        before, proposer = after.interventions, self._proposer(memories, worlds)
        applied = after.decide(worlds, proposed[:, 0], proposer, only=~running.ended)[:, np.newaxis]
        stepped_in = after.interventions > before
        return Ruling(proposed, applied, stepped_in, ~running.ended, after.decision, Guarded(after, memories))

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos of a step that is certified in the estimated worlds, as a mapping.

        ``trusted`` is true in mode ``robust``, because only there the bound may also hold in the true world. ``memory``
        has the shield after the step; ``ruling`` is its decision (None at the reset).
        """
        estimated: EstimatedShield = memory.shield
        robust, shield = estimated.robust is not None, estimated.shield
        infos = self._of_step(ruling) | why(ruling)
        infos |= {"bound_harm": np.inf, "settles": False, "estimated": True, "trusted": robust}
        if ruling is not None:
            infos["bound_harm"] = np.where(np.isfinite(estimated.predicted_harm), shield.bound, np.inf)
            infos["settles"] = shield.memory.settles
        if robust:
            infos["members"] = estimated.members
        return infos
