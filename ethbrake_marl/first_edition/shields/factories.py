"""Registry entries of the core shields, ``+episode`` and ``+step``."""

from __future__ import annotations

from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Source
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.shields.drivers import shielded
from ethbrake_marl.first_edition.shields.options import ShieldOptions
from ethbrake_marl.first_edition.shields.paper_hybrid import Bound, HybridAgent
from ethbrake_marl.registry import Part


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> HybridAgent:
    """Return ``policy`` behind the paper's Algorithm 1 (``+episode``).

    ``argument`` is None, or ``pairwise`` for the paper's closed form of E-V2X-BM. ``settings`` must contain the key
    ``scenario``.
    """
    bound: Bound = "coupled" if argument is None else "pairwise"
    return HybridAgent(policy, settings.needed_scenario(), bound=bound, harm_count=settings.harm_count)


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the agent or team ``policy`` behind a shield of mode ``step`` (``+step``).

    ``argument`` is ignored. ``settings`` must contain the key ``scenario``. If the scenario has several learners, a
    copy of the agent drives each of them.
    """
    return shielded(policy, settings.needed_scenario(), "step", harm_count=settings.harm_count)


EPISODE = Part(
    shield_episodes,
    form="+episode[:pairwise]",
    about="behind Algorithm 1: the agent or E-V2X-BM, whichever does less harm, drives the whole episode",
    knows=Source.MODEL,
    options=ShieldOptions,
)

STEP = Part(
    shield_steps,
    form="+step",
    about="behind a shield that certifies or replaces every action; the actions of a team together",
    knows=Source.MODEL,
    teams=True,
    options=ShieldOptions,
)
