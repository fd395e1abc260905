"""Letting agents drive through whole episodes: the loop of every evaluation and of every prediction."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ethbrake_marl.agents.protocol import Agent, AgentAround, Driver, LookingAhead, Shielding, Team
from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.harm import Ledger
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import unpack
from ethbrake_marl.physics.kernel import decision_at, first_decision_s
from ethbrake_marl.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Episodes:
    """How the episodes of a batch went."""

    ledger: Ledger
    final: Worlds  # each world as its episode left it
    at_rest: Bools  # [n] the line came to rest; else the horizon cut the episode off
    guarded: Any = None  # what the shield remembers at their end; None without one


class Watch(Protocol):
    """Sees every step of a batch of episodes."""

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """``before`` moved to the times ``until_s`` [n] under ``command_mps2`` [n, N]; ended worlds stay at theirs.

        The first step is from the alert to the first decision; where a script decides on the way, a step is seen in
        parts. Nothing of what is given may be changed.
        """
        ...


def script_agents(scenario: Scenario, *, except_for: int | Collection[int] | None = None) -> dict[int, Agent]:
    """Fresh agents for the scenario's scripts, by vehicle; those that look ahead know the others."""
    left_out = () if except_for is None else (except_for,) if isinstance(except_for, int) else except_for
    specs = {i: spec for i, spec in scenario.scripts.items() if i not in left_out}
    scripts = {
        i: make_single_agent(spec, horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s)
        for i, spec in specs.items()
    }
    for vehicle, script in scripts.items():
        set_others(script, vehicle, scripts)
    return scripts


def set_others(agent: Agent, vehicle: int, scripts: Mapping[int, Script]) -> None:
    """Tell an agent that looks ahead, and will drive ``vehicle``, who drives the others."""
    if isinstance(agent, LookingAhead):
        agent.others = {i: script for i, script in scripts.items() if i != vehicle}


def episode_engine(worlds: Worlds, agent: Driver, scenario: Scenario, vehicle: int | None = None) -> Engine:
    """An engine over ``worlds`` in which ``agent`` drives ``vehicle``, or a team its vehicles; the others are scripted.

    They decide when their first vehicle's latency has elapsed and every time step from then on, as learners do; their
    commands are applied unrounded. Behind a shield they propose, and learn as far as the engine knows. One that looks
    ahead knows the scripts, and takes the other driven vehicles to
    brake fully. Raises ``InvalidInput`` for a learner that nobody drives.
    """
    driven = () if vehicle is None else (vehicle,)
    if isinstance(agent, Shielding):
        team = agent.on(driven)
    else:
        team = agent if isinstance(agent, Team) else Team(dict.fromkeys(driven, agent), agent.name)
    drivers = team.drivers
    undriven = [scenario.vehicle_names[i] for i in scenario.learners if i not in drivers]
    if undriven:
        raise InvalidInput(
            f"agent {team.name!r} drives {', '.join(scenario.vehicle_names[i] for i in drivers) or 'nobody'}, but"
            f" {', '.join(undriven)} of scenario {scenario.name!r} must be driven too. An agent that rolls itself out"
            " (+refined, +episode, +robust) can drive one learner, the others need scripts: --vehicle NAME"
        )
    scripts = script_agents(scenario, except_for=drivers)
    shield = team.shield
    if shield is None:
        for i, driver in drivers.items():
            set_others(driver, i, scripts)
        engine = Engine(
            scenario, worlds.n, learners=(), scripts={**scripts, **drivers}, deciders=tuple(drivers), worlds=worlds
        )
    else:
        engine = Engine(
            scenario, worlds.n, learners=tuple(drivers), scripts=scripts, worlds=worlds,
            guard=lambda engine: shield.guard(engine, drivers),
        )  # fmt: skip
    engine.roster.warns = False  # who drives looks
    return engine


def drive(
    worlds: Worlds,
    agent: Driver,
    scenario: Scenario,
    vehicle: int | None = None,
    *,
    watched_by: Sequence[Watch] = (),
) -> Episodes:
    """Let ``agent`` drive ``vehicle``, or a team its vehicles, through every world (at t = 0) to its episode's end.

    Raises ``PhysicsError`` naming all worlds that could not be advanced; the others are well without them.
    """
    return play(episode_engine(worlds, agent, scenario, vehicle), worlds, watched_by)


def play(engine: Engine, worlds: Worlds, watched_by: Sequence[Watch] = ()) -> Episodes:
    """The episodes of such an engine, which is still at the first decision in ``worlds``; raises ``PhysicsError``."""
    at_rest = np.zeros(worlds.n, np.bool_)
    now = _show(watched_by, worlds, engine, engine.worlds.command_mps2)
    while not engine.ended.all():
        at_rest |= engine.step({}).terminated
        now = _show(watched_by, now, engine, engine.wanted_mps2.copy())
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    return Episodes(engine.ledger, engine.worlds, at_rest, engine.guarded)


def _show(watched_by: Sequence[Watch], before: Worlds, engine: Engine, command_mps2: Floats) -> Worlds:
    """Show the step that the engine has just made; gives the worlds as they are now."""
    if not watched_by:
        return before
    now = unpack(engine.packed, before.vehicles)  # the episodes are the same, and so are their vehicles
    for part in engine.segments(before, command_mps2):
        for watch in watched_by:
            watch.see(*part)
    return now


# The recorder of an agent: its commands in each step of its episodes.


def record_commands(agent: Driver, worlds: Worlds, scenario: Scenario, vehicle: int, steps: int) -> Floats:
    """The commands that ``agent`` gives ``vehicle`` in the first ``steps`` decisions of its episodes, [n, steps] m/s2.

    ``worlds`` are at the alert. After an episode's end its last command goes on. Raises ``PhysicsError`` naming the
    worlds that it cannot drive to the end.
    """
    if isinstance(agent, Agent):
        recorder = _Recorder(agent, steps, scenario.time_step_s)
        drive(worlds, recorder, scenario, vehicle)
        commands = recorder.commands_mps2
    else:
        commands = _applied_commands(episode_engine(worlds, agent, scenario, vehicle), vehicle, steps)
    latest = np.maximum.accumulate(np.where(np.isnan(commands), 0, np.arange(steps)), axis=1)
    filled: Floats = np.take_along_axis(commands, latest, axis=1)
    return filled


def _applied_commands(engine: Engine, vehicle: int, steps: int) -> Floats:
    """What is applied in place of what somebody proposes, [n, steps]; NaN after an episode's end."""
    commands = np.full((engine.n, steps), np.nan)
    while not engine.ended.all():
        rows = np.flatnonzero(~engine.ended & (engine.steps < steps))
        at = engine.steps[rows]
        engine.step({})
        commands[rows, at] = engine.wanted_mps2[rows, vehicle]
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    return commands


class _Recorder(AgentAround):
    """An agent that drives as another one does and keeps every command."""

    def __init__(self, agent: Agent, steps: int, time_step_s: float) -> None:
        super().__init__(agent)
        self.commands_mps2: Floats = np.empty((0, steps))  # [n, steps], NaN after an episode's end
        self._time_step_s = time_step_s
        self._start_s: Floats = np.empty(0)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """All episodes begin at once here."""
        self._start_s = first_decision_s(worlds, [vehicle])
        self.commands_mps2 = np.full((worlds.n, self.commands_mps2.shape[1]), np.nan)
        super().begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        command = self.policy.act(worlds, vehicle)
        step = decision_at(worlds.time_s, self._start_s, self._time_step_s)
        deciding = np.flatnonzero((step >= 0) & (step < self.commands_mps2.shape[1]))
        self.commands_mps2[deciding, step[deciding]] = command[deciding]
        return command
