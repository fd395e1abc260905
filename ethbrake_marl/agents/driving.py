"""Letting an agent drive one vehicle through whole episodes: the loop of every evaluation and of every prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.protocol import Agent, LookingAhead
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.harm import Ledger
from ethbrake_marl.physics import Bools, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.starts import Script


@dataclass(frozen=True, slots=True)
class Episodes:
    """How the episodes of a batch went."""

    ledger: Ledger
    final: Worlds  # each world as its episode left it
    at_rest: Bools  # [n] the line came to rest; else the horizon cut the episode off


def scripted(scenario: Scenario, *, but: int | None = None) -> dict[int, Agent]:
    """Fresh agents for the scenario's scripts, by vehicle index, ``but`` one; those that look ahead know the others."""
    specs = {i: spec for i, spec in scenario.scripts.items() if i != but}
    scripts = {i: make_agent(spec, horizon_s=scenario.horizon_s) for i, spec in specs.items()}
    for vehicle, script in scripts.items():
        introduce(script, vehicle, scripts)
    return scripts


def introduce(agent: Agent, vehicle: int, scripts: Mapping[int, Script]) -> None:
    """Tell an agent that looks ahead, and will drive ``vehicle``, who drives the others."""
    if isinstance(agent, LookingAhead):
        agent.others = {i: script for i, script in scripts.items() if i != vehicle}


def episode_engine(worlds: Worlds, agent: Agent, scenario: Scenario, vehicle: int) -> Engine:
    """An engine over ``worlds`` in which ``agent`` drives ``vehicle`` and the others follow the scenario's scripts.

    The agent decides when that vehicle's latency has elapsed and every time step from then on, as a learner does; its
    commands are applied unrounded.
    """
    scripts = scripted(scenario, but=vehicle)
    introduce(agent, vehicle, scripts)
    return Engine(
        scenario, worlds.n, learners=(), scripts={**scripts, vehicle: agent}, deciders=(vehicle,), worlds=worlds
    )


def drive(worlds: Worlds, agent: Agent, scenario: Scenario, vehicle: int) -> Episodes:
    """Let ``agent`` drive ``vehicle`` through every world (at t = 0) to its episode's end."""
    engine = episode_engine(worlds, agent, scenario, vehicle)
    at_rest = np.zeros(worlds.n, np.bool_)
    while not engine.ended.all():
        at_rest |= engine.step({}).terminated
    return Episodes(engine.ledger, engine.worlds, at_rest)
