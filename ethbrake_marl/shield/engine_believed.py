"""Step and robust mode on a running engine, certified on what was really received: ``believed=True`` of a wrapper."""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.rollout import set_others
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.stream import begin_script
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.shield.believed import BelievedShield
from ethbrake_marl.shield.certify import REASONS
from ethbrake_marl.shield.engine_shield import Attached, Proposing, Sent
from ethbrake_marl.shield.options import ShieldOptions
from ethbrake_marl.shield.settings import proposing_agents, shielded_vehicles
from ethbrake_marl.shield.told import told_before


class AttachedBelieved(Attached):
    """A ``BelievedShield`` that begins with the engine's episodes, and is shown the engine's worlds.

    Its bound is told once the first decision was made, and is that of the belief: what happens is not compared with
    what was foretold, as that may be wrong without anybody's fault.
    """

    vehicle: int

    def __init__(self, engine: Engine, policy: Proposing | None, options: ShieldOptions) -> None:
        vehicle = shielded_vehicles(engine, options.where, options.mode)
        if not isinstance(vehicle, int):
            raise InvalidInput(
                f"{options.where}: believed = True: shields one learner, not several; pass learners=['vehicle_2'] to"
                " the environment"
            )
        robust = options.robust if options.mode == "robust" else None
        shield = BelievedShield(engine.scenario, harm_count=options.harm_count, robust=robust, others=engine.scripts)
        self.policies = None if policy is None else proposing_agents(policy, (vehicle,), options.where)
        super().__init__(engine, options, shield)

    @property
    def believed(self) -> BelievedShield:
        """The shield as it is now: to be read; the next step puts another one in its place."""
        believed: BelievedShield = self.memory
        return believed

    @property
    def running(self) -> bool:
        """Whether any episode has begun."""
        return self.believed.predicted_harm.size > 0

    @property
    def stepped_in(self) -> Bools:
        """Where a proposal was replaced, [n]."""
        decision = None if self.sent is None else self.believed.decision
        return np.zeros(self.engine.n, np.bool_) if decision is None else decision.intervened

    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply instead of those proposed; the engine applies them."""
        memory, engine = self.believed, self.engine
        if self.remembering:
            self.ask_policies()
        after, worlds = memory.branch(), engine.worlds
        command = after.decide(worlds, self.vehicle, lambda: np.asarray(proposed, np.float64), self.policies)
        applied = command_to_action(command, worlds.vehicles, self.vehicle)
        self.sent = Sent(memory, engine.steps_made, applied, ~engine.ended, None, after)
        return applied

    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """What the shield decided in world ``k``; ``trusted``: the mode promises something of the world as it is."""
        assert self.sent is not None and isinstance(self.sent.after, BelievedShield)
        after = self.sent.after
        decision, shield = after.decision, after.shield
        assert decision is not None and shield is not None
        return told_before(shield, k) | {
            "proposed_action": proposed,
            "chosen_action": float(self.sent.applied[k]),
            "intervened": bool(decision.intervened[k]),
            "reason": REASONS[int(decision.reason[k])],
            "margin": float(decision.margin[k]),
            "bound_harm": float(shield.bound[k]) if np.isfinite(after.predicted_harm[k]) else np.inf,
            **self._marks(),
        }

    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """The same keys before the first decision of world ``k``: nothing was certified, and the bound is infinite."""
        told = {"mode": self.options.mode, "proposed_action": 0.0, "chosen_action": 0.0, "intervened": False}
        told |= {"reason": "", "bound_harm": np.inf, "margin": 0.0, "settles": False, **self._marks()}
        return told | ({} if self.believed.robust is None else {"members": self.believed.members})

    def _marks(self) -> dict[str, bool]:
        return {"believed": True, "trusted": self.believed.robust is not None}

    def begun(self, memory: BelievedShield, alert: Worlds, rows: Ints) -> BelievedShield:
        """The shield once episodes start in these rows."""
        for vehicle, policy in (self.policies or {}).items():
            set_others(policy, vehicle, self.engine.scripts)
            begin_script(policy, alert, vehicle, rows)
        shield = memory.branch()
        shield.begin(alert, self.vehicle, rows)
        return shield

    def _carried_out(self, memory: BelievedShield, sent: Sent, after: Engine) -> object:
        return sent.after
