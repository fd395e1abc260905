"""Episode mode on a running engine, and the shield of each mode."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.shield.agents import HybridAgent
from ethbrake_marl.shield.engine_believed import AttachedBelieved
from ethbrake_marl.shield.engine_shield import Attached, AttachedShield, Proposing, Sent
from ethbrake_marl.shield.options import ShieldOptions
from ethbrake_marl.shield.settings import proposing_agent, shielded_vehicles

ROUNDING = 1e-6  # of an action in 32 bits


class EpisodeChoice(NamedTuple):
    """What episode mode remembers: who drives, and that nothing was asked of it yet at this decision."""

    hybrid: HybridAgent


class AttachedHybrid(Attached):
    """Episode mode on a running engine: ``HybridAgent`` chooses at each alert, and its action alone may be applied."""

    vehicle: int

    def __init__(self, engine: Engine, policy: Proposing | None, options: ShieldOptions) -> None:
        shielded_vehicles(engine, options.where, options.mode)
        agent = proposing_agent(policy, options.where)
        hybrid = HybridAgent(agent, engine.scenario, bound=options.bound, harm_count=options.harm_count)
        super().__init__(engine, options, EpisodeChoice(hybrid))

    @property
    def hybrid(self) -> HybridAgent:
        """The agent that drives, as it is now."""
        choice: EpisodeChoice = self.memory
        return choice.hybrid

    @property
    def running(self) -> bool:
        """Whether any episode has begun."""
        return self.hybrid.policy_harm.size > 0

    @property
    def stepped_in(self) -> Bools:
        """Where E-V2X-BM drives the episode instead of the policy, [n]."""
        replaced: Bools = ~self.hybrid.chosen_policy
        return replaced

    def proposal(self) -> Floats:
        """NaN: the agent that was chosen drives, whatever is proposed."""
        return np.full(self.engine.n, np.nan)

    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply. Asked again before they were applied, the agent is not asked again."""
        memory, engine = self.memory, self.engine
        if self.sent is None or self.sent.memory is not memory:
            worlds = engine.worlds
            applied = command_to_action(memory.hybrid.act(worlds, self.vehicle), worlds.vehicles, self.vehicle)
            self.sent = Sent(memory, engine.steps_made, applied, ~engine.ended, None)
        return self.sent.applied

    def begun(self, memory: EpisodeChoice, alert: Worlds, rows: Ints) -> EpisodeChoice:
        """Who drives the episodes that start in these rows."""
        hybrid = copy.copy(memory.hybrid)
        hybrid.backup = copy.copy(hybrid.backup)
        hybrid.begin(alert, self.vehicle, rows)
        return EpisodeChoice(hybrid)

    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """Who drives the episode of world ``k``; ``proposed_action`` is NaN when nothing was proposed.

        A proposal counts as replaced where it differs by more than the rounding of its 32 bits.
        """
        assert self.sent is not None and isinstance(self.sent.memory, EpisodeChoice)
        applied, hybrid = float(self.sent.applied[k]), self.sent.memory.hybrid  # now the next episode may have begun
        return {
            "mode": "episode",
            "proposed_action": proposed,
            "chosen_action": applied,
            "intervened": abs(applied - proposed) > ROUNDING,
            "chosen_policy": bool(hybrid.chosen_policy[k]),
            "policy_harm": float(hybrid.policy_harm[k]),
            "bound_harm": float(hybrid.bound_harm[k]),
        }

    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """Who will drive the episode of world ``k``, before the first decision."""
        return {
            "mode": "episode",
            "proposed_action": 0.0,
            "chosen_action": 0.0,
            "intervened": False,
            "chosen_policy": bool(self.hybrid.chosen_policy[k]),
            "policy_harm": float(self.hybrid.policy_harm[k]),
            "bound_harm": float(self.hybrid.bound_harm[k]),
        }

    def _carried_out(self, memory: EpisodeChoice, sent: Sent, after: Engine) -> EpisodeChoice:
        return EpisodeChoice(memory.hybrid)  # another one: the next decision is another one, too


def attach(engine: Engine, policy: Proposing | None, options: ShieldOptions) -> Attached:
    """The shield of the options' mode on a running engine."""
    if options.mode == "episode":
        return AttachedHybrid(engine, policy, options)
    if options.believed:
        return AttachedBelieved(engine, policy, options)
    return AttachedShield(engine, policy, options)
