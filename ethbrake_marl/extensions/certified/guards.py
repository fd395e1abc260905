"""Guards of the shields for incomplete knowledge: modes ``robust`` and ``estimated``.

A *guard* connects a shield with a running engine.
"""

from __future__ import annotations

import copy
from enum import IntEnum
from typing import Any

import numpy as np

from ethbrake_marl.extensions.certified.estimated_shield import EstimatedShield
from ethbrake_marl.first_edition.engine.engine import Engine, Ruling
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds
from ethbrake_marl.first_edition.shields.contract import Guarded, ShieldGuard, why
from ethbrake_marl.first_edition.shields.guard import StepGuard


class RobustMode(IntEnum):
    """Value of the info ``shield_mode`` in mode ``robust``. ``eb.ShieldMode`` contains the values for other modes."""

    ROBUST = 2


class RobustGuard(StepGuard):
    """Guard of mode ``robust``: at each step of the engine, a ``RobustShield`` decides which actions the engine
    applies.
    """

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos of a step. ``ruling`` is None at the reset of the environment.

        The info ``members`` is the number of possible worlds that represent each true world; an action is certified in
        all of these possible worlds.
        """
        return super().tell(memory, ruling) | {"members": memory.shield.memory.running.members}


class EstimatedGuard(ShieldGuard):
    """Guard of modes ``step`` and ``robust`` in the estimated world: an ``EstimatedShield`` decides which actions the
    engine applies.

    The shield promises a bound on harm from the first decision on; this bound holds in the estimated world. The guard
    does not compare the true motion with the predicted motion: estimates may be wrong, so a difference is no error.
    """

    def _started(self, shield: EstimatedShield, alert: Worlds, rows: Ints) -> EstimatedShield:
        shield.begin(alert, rows)
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Return the proposed actions, and the actions to apply, which are certified in the estimated worlds.

        ``running`` and ``memory`` are in their state before the step; ``proposed`` [n, 1] are the actions that the
        policy proposes.
        """
        worlds = running.worlds
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        after = copy.copy(memory.shield)
        before, proposer = after.interventions, self._proposer(memories, worlds)
        applied = after.decide(worlds, proposed[:, 0], proposer, only=~running.ended)[:, np.newaxis]
        stepped_in = after.interventions > before
        return Ruling(proposed, applied, stepped_in, ~running.ended, after.decision, Guarded(after, memories))

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos of a step. ``ruling`` is None at the reset of the environment.

        The info ``trusted`` is true in mode ``robust`` and false in mode ``step``, because only mode ``robust`` has a
        bound that may also hold in the true world.
        """
        estimated: EstimatedShield = memory.shield
        robust, shield = estimated.robust, estimated.shield
        infos = self._of_step(ruling) | why(ruling)
        infos |= {"bound_harm": np.inf, "settles": False, "estimated": True, "trusted": robust}
        if ruling is not None:
            infos["bound_harm"] = np.where(np.isfinite(estimated.predicted_harm), shield.bound, np.inf)
            infos["settles"] = shield.memory.settles
        if robust:
            infos["members"] = estimated.members
        return infos
