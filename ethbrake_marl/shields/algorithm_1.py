"""The paper's hybrid (Algorithm 1): at the alert, either a policy or E-V2X-BM gets the whole episode.

It compares the harm of the policy's rollout with H*, the harm of E-V2X-BM's constant deceleration, and chooses the
driver with the smaller harm. With H* of ``coupled``, the harm of the episode is the smaller of the two, to the last
bit, if the policy is deterministic. The paper's own H*, of ``pairwise``, bounds nothing: it is about half of the harm
that the deceleration does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.team import Agent
from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.episode.counts import FIRST_IMPACTS, HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MODEL
from ethbrake_marl.episode.play import price
from ethbrake_marl.episode.script_calls import begin_script
from ethbrake_marl.episode.state import END, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.fallbacks import AGENTS, ask_agents, constant_plans, rollout
from ethbrake_marl.shields.shield import NamedShield, check_drivers, checked_drivers, report_of, spread

ACTION_ROUNDING = 1e-6  # of an action in 32 bits; a proposal within it counts as the applied action


class EpisodeShieldMemory(NamedTuple):
    """What the shield remembers between two decisions."""

    chosen: Bools  # [n] whether the policy drives
    policy_harm: Floats  # [n] harm of the policy's play (m2/s2)
    bound_harm: Floats  # [n] H* (m2/s2)
    backup: Floats  # [n, 1] action of E-V2X-BM
    agent: Any  # memory of the policy
    proposed: Floats  # [n, 1] last proposal
    applied: Floats  # [n, 1] last action
    intervened: Bools  # [n, N] whether proposal and action differ


class EpisodeShield:
    """Algorithm 1 of the paper, for one learner. Actions that the caller proposes have no effect.

    Args:
        drivers: the learner's vehicle (1: Vehicle 1) -> its policy.
        harm_count: count of harm to compare (``episode.counts``). ``pairwise`` always compares first-impact harm.
        bound: how H*, the harm of E-V2X-BM, is computed: ``coupled`` (the episode's own physics) or ``pairwise`` (the
        paper's closed form).

    """

    def __init__(
        self, drivers: Mapping[int, Agent] | None, *, harm_count: AnyCount = HONEST, bound: str = "coupled"
    ) -> None:
        count = HarmCount.of(harm_count, "shield: harm_count")
        if bound not in ("coupled", "pairwise"):
            raise InvalidInput(f"shield: bound = {bound!r}: must be 'coupled' or 'pairwise'")
        self.drivers, self.coupled = checked_drivers(drivers), bound == "coupled"
        self.harm_count = count if self.coupled else FIRST_IMPACTS  # which the closed form predicts
        if len(self.drivers) != 1:
            raise InvalidInput(
                f"shield: mode 'episode' needs the policy of exactly one learner, not of {len(self.drivers)}; mode"
                " 'step' guards several, and needs none"
            )

    def begin(self, game: Game, alert: State, state: State) -> EpisodeShieldMemory:
        """Memory at the first decision: whether the policy or E-V2X-BM drives each world."""
        check_drivers(game, self.drivers)
        ((body, agent),) = self.drivers.items()
        remembered = begin_script(game.agents({body: agent})[body], alert, body)
        worlds = alert._replace(wanted=state.wanted)
        choice = coupled(worlds, body, self.harm_count, state.clock[:, END]) if self.coupled else pairwise(worlds, body)
        backup = actions_of(alert, body, -choice.deceleration_mps2)[:, np.newaxis]
        held_back = constant_plans(game, backup)
        policy_state = state._replace(memories={**state.memories, AGENTS: {body: remembered}})
        policy_harm = price(
            game, state, rollout(game, self.drivers, policy_state, held_back, self.harm_count), self.harm_count
        )
        bound_harm = price(game, state, held_back, self.harm_count) if self.coupled else choice.harm
        nothing = np.zeros((state.n, 1))
        return EpisodeShieldMemory(
            policy_harm <= bound_harm, policy_harm, bound_harm, backup, remembered, nothing, nothing,
            np.zeros((state.n, state.vehicles), np.bool_),
        )  # fmt: skip

    def decide(
        self, game: Game, state: State, proposed: Floats | None, *, donate: bool
    ) -> tuple[Floats, EpisodeShieldMemory]:
        memory: EpisodeShieldMemory = state.memories["shield"]
        (body,) = self.drivers
        policy_actions, after = ask_agents(game.agents(self.drivers), state, {body: memory.agent})
        proposed = policy_actions if proposed is None else np.where(np.isnan(proposed), policy_actions, proposed)
        applied = np.where(memory.chosen[:, np.newaxis], policy_actions, memory.backup)
        differ = (np.abs(applied - proposed) > ACTION_ROUNDING) & ~state.ended[:, np.newaxis]
        return applied, memory._replace(
            agent=after[body], proposed=proposed, applied=applied, intervened=spread(game, state, differ, False)
        )

    def measures(self, game: Game, last: State) -> dict[str, Any]:
        memory: EpisodeShieldMemory = last.memories["shield"]
        (body,) = self.drivers
        return {"replaced": {"none": memory.chosen}, **report_of(self.drivers, last, {body: memory.agent})}

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        memory: EpisodeShieldMemory = state.memories["shield"]
        return {
            "chosen_policy": memory.chosen,
            "policy_harm": memory.policy_harm,
            "bound_harm": memory.bound_harm,
            "proposed_action": spread(game, state, memory.proposed),
            "applied_action": spread(game, state, memory.applied),
            "intervened": memory.intervened,
        }


EPISODE = Part(
    NamedShield(EpisodeShield, "bound"),
    form="episode[:pairwise]",
    about="the paper's hybrid: the policy or E-V2X-BM drives the whole episode",
    knows=MODEL,
)
