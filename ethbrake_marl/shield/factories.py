"""Factories of what the registry puts around an agent: the shields, with and without ``:believed``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.agents.believing import Believing, split_believed
from ethbrake_marl.agents.knowledge import Knowledge, Source, combine
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Ints, Worlds
from ethbrake_marl.physics.worlds import vehicles_at_once
from ethbrake_marl.shield.agents import Bound, HybridAgent, StepShieldAgent
from ethbrake_marl.shield.believed_agent import BelievedShieldAgent
from ethbrake_marl.shield.interior import CORNERS, checked_robust
from ethbrake_marl.shield.team_agent import ShieldedTeam
from ethbrake_marl.shield.uncertainty import mode_uncertainty


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return combine(self.policy.policy, also=Source.BELIEFS)

    def _begin_policy(self, believed: Worlds, vehicle: int, rows: Ints) -> None:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = vehicles_at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution
        )
        line = replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip
        super()._begin_policy(line, vehicle, rows)


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent, with ``:believed`` behind on what was received."""
    pairwise, believes = split_believed(argument)
    bound: Bound = "coupled" if pairwise is None else "pairwise"
    scenario = settings.needed_scenario()
    hybrid = HybridAgent(policy, scenario, bound=bound, harm_count=settings.harm_count)
    if believes and isinstance(policy, Believing):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return BelievingHybrid(hybrid, scenario) if believes else hybrid


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent or a team, where several vehicles learn around a copy for each; ``+step:believed``."""
    scenario, harm_count, believes = settings.needed_scenario(), settings.harm_count, split_believed(argument)[1]
    if not isinstance(policy, Team) and len(scenario.learners) <= 1:
        make = BelievedShieldAgent if believes else StepShieldAgent
        return make(policy, scenario, harm_count=harm_count)
    if believes:
        raise InvalidInput(f"agent {settings.spec!r}: :believed shields one learner, not several; take +step")
    team = policy if isinstance(policy, Team) else Team.copies(policy, scenario.learners)
    return ShieldedTeam(team, scenario, harm_count=harm_count)


def shield_steps_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+robust`` or ``+robust:interior``, against the uncertainty of the settings.

    With ``:believed`` behind, against all that was not received, without one.
    """
    scenario, where, harm_count = settings.needed_scenario(), f"agent {settings.spec!r}", settings.harm_count
    certainty, believes = split_believed(argument)
    robust = checked_robust(certainty or CORNERS, where)
    if believes:
        return BelievedShieldAgent(policy, scenario, harm_count=harm_count, robust=robust)
    uncertainty = mode_uncertainty("robust", settings.uncertainty, where)
    return StepShieldAgent(policy, scenario, harm_count=harm_count, uncertainty=uncertainty, robust=robust)
