"""Shields by name: what ``+episode``, ``+step`` and ``+robust`` put around an agent."""

from __future__ import annotations

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.shield.agents import Bound, HybridAgent, StepShieldAgent
from ethbrake_marl.shield.team_agent import ShieldedTeam
from ethbrake_marl.shield.uncertainty import mode_uncertainty


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent."""
    bound: Bound = "coupled" if argument is None else "pairwise"
    return HybridAgent(policy, settings.needed_scenario(), bound=bound, harm_count=settings.harm_count)


def shield_steps(policy: Driver, argument: None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent, or around a team; where several vehicles learn, around a copy for each."""
    scenario, harm_count = settings.needed_scenario(), settings.harm_count
    if isinstance(policy, Team):
        return ShieldedTeam(policy, scenario, harm_count=harm_count)
    if len(scenario.learners) > 1:
        return ShieldedTeam(Team.copies(policy, scenario.learners), scenario, harm_count=harm_count)
    return StepShieldAgent(policy, scenario, harm_count=harm_count)


def shield_steps_robustly(policy: Agent, argument: None, settings: AgentSettings) -> Agent:
    """``+robust`` around an agent, against the uncertainty of the settings."""
    scenario, where = settings.needed_scenario(), f"agent {settings.spec!r}"
    uncertainty = mode_uncertainty("robust", settings.uncertainty, where)
    return StepShieldAgent(policy, scenario, harm_count=settings.harm_count, uncertainty=uncertainty)
