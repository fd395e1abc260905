"""Step mode attached to a running engine: what every wrapped face shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.profile_problem import state_columns
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.harm import COUNTS, HarmCount
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.obstacle import obstacle_ahead
from ethbrake_marl.shield.certify import REASONS, Decision
from ethbrake_marl.shield.guard import StepShield
from ethbrake_marl.shield.rollouts import Proposer, proposed_action
from ethbrake_marl.shield.settings import only_shielded, proposing_agent
from ethbrake_marl.shield.uncertainty import Uncertainty, checked_uncertainty


class AttachedShield:
    """A ``StepShield`` that begins with the engine's episodes and sees the engine's worlds.

    ``policy`` (an agent, a loaded policy, or None) is rolled out at each alert, and proposes where nobody else does.
    ``where`` is who builds it, for messages. Raises ``InvalidInput`` for another number of learners than one.
    """

    def __init__(
        self,
        engine: Engine,
        policy: Agent | LearnedPolicy | None,
        *,
        count: HarmCount = "first",
        allowance: float = 0.0,
        uncertainty: Uncertainty | str | None = None,
        logging: bool = False,
        where: str = "shield",
    ) -> None:
        self.engine = engine
        self.vehicle = only_shielded(engine, where)
        self.policy = None if policy is None else proposing_agent(policy, where)
        self.shield = StepShield(
            self.engine.scenario, self.vehicle, count=count, allowance=allowance, others=self.engine.scripts,
            uncertainty=checked_uncertainty(uncertainty), logging=logging,
        )  # fmt: skip
        self.decision: Decision | None = None
        self.engine.on_begin.append(self._begin)

    def proposal(self) -> Floats:
        """What the policy itself would do now, as actions [n]."""
        if self.policy is None:
            raise InvalidInput("shield: no action was given, and there is no policy that could propose one")
        return proposed_action(self.policy, self.engine.worlds, self.vehicle)

    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply instead of those proposed."""
        worlds, ledger = self.engine.worlds, self.engine.ledger
        harm = [ledger.first_impact_harm, ledger.total_harm]
        if obstacle_ahead(worlds).any():
            harm = [np.column_stack([ledger.hazard_harm(c), ledger.pair_harm(c)]) for c in COUNTS]
        seen = np.concatenate([state_columns(worlds), *harm], axis=1)
        proposer = None if self.policy is None else Proposer(self.policy, worlds)
        self.decision = self.shield.decide(proposed, seen=seen, only=~self.engine.ended, proposer=proposer)
        return self.decision.applied

    def check_applied(self, only: Bools | None = None) -> None:
        """Raise ``EthBrakeError`` if the engine did not apply what was certified, in all worlds or ``only`` in some."""
        assert self.decision is not None
        certified = self.shield.commands(self.decision.applied)
        wanted = self.engine.wanted_mps2[:, self.vehicle]
        running = self.decision.reason != REASONS.index("ended")
        if not (wanted == certified)[running if only is None else running & only].all():
            raise EthBrakeError("shield: the applied command is not the certified one; is something between them?")

    def info(self, k: int, proposed: float, decision: Decision) -> dict[str, Any]:
        """What the shield did in world ``k``, for ``infos[agent]["shield"]``."""
        return {
            "mode": "step" if self.shield.uncertainty is None else "robust",
            "proposed_action": proposed,
            "applied_action": float(decision.applied[k]),
            "intervened": bool(decision.intervened[k]),
            "reason": REASONS[decision.reason[k]],
            "bound_harm": float(decision.bound[k]),
            "margin": float(decision.margin[k]),
            "trusted": not self.shield.distrusted[k],
            **({} if self.shield.uncertainty is None else {"members": decision.after.members}),
        }

    def infos(self, proposed: Floats) -> dict[str, NDArray[Any]]:
        """The same of every world, one array per key; of the decision that was made last."""
        assert self.decision is not None
        rows = [self.info(k, float(proposed[k]), self.decision) for k in range(len(proposed))]
        return {key: np.array([row[key] for row in rows]) for key in rows[0]}

    def detach(self) -> None:
        """Let go of the engine: it no longer asks this shield when an episode starts."""
        if self._begin in self.engine.on_begin:
            self.engine.on_begin.remove(self._begin)

    def _begin(self, worlds: Worlds, rows: Ints) -> None:
        if self.policy is not None:
            self.policy.begin(worlds, self.vehicle, rows)
        self.shield.begin(worlds, rows, self.policy)
