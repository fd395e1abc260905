"""Run agents through whole episodes: the loop of every evaluation and every prediction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ethbrake_marl.agents.making import make_role
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.agents.registry import around_one_vehicle
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.memory import Memory
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.game.harm import Ledger
from ethbrake_marl.physics.state import Bools, Floats, Worlds
from ethbrake_marl.scenario.schema import Scenario


@dataclass(frozen=True, slots=True)
class Episodes:
    """Result of a batch of episodes."""

    ledger: Ledger
    final: Worlds  # each world at the end of its episode
    at_rest: Bools  # [n] whether the line came to rest; otherwise the episode ended at the horizon
    guarded: Any  # memory of the shield at the end; None without a shield
    memories: Mapping[int, Memory]  # controlled vehicle -> memory of its agent at the end

    @classmethod
    def of(cls, engine: Engine, worlds: Worlds, watched_by: Sequence[Watch] = ()) -> Episodes:
        """Run an ``episode_engine`` from the first decision in ``worlds`` to the end; raise ``PhysicsError``."""
        at_rest = np.zeros(worlds.n, np.bool_)
        now = _show(watched_by, worlds, engine, engine.worlds.command_mps2)
        while not engine.ended.all():
            at_rest |= engine.step({}).terminated
            now = _show(watched_by, now, engine, engine.wanted_mps2.copy())
        if engine.roster.failed:
            raise PhysicsError(engine.roster.failed)
        memories = {i: memory for i, memory in engine.memories.items() if i in engine.deciders}
        return cls(engine.ledger, engine.worlds, at_rest, engine.guarded, memories)


class Watch(Protocol):
    """Observer of every step of a batch of episodes."""

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Called with a step: ``before`` moves to the times ``until_s`` [n] under ``command_mps2`` [n, N].

        Ended worlds stay at their times. The first step is from the alert to the first decision. If a script decides
        within a step, the step is passed in parts. The arguments must not be changed.
        """
        ...


def script_agents(scenario: Scenario, *, except_for: int | Collection[int] | None = None) -> dict[int, Agent]:
    """Return vehicle -> agent for the scenario's scripts, without the vehicles in ``except_for``."""
    left_out = (except_for,) if isinstance(except_for, int) else except_for or ()
    return {i: make_role(scenario, i) for i in scenario.scripts if i not in left_out}


def episode_engine(worlds: Worlds, agent: Driver, scenario: Scenario, vehicle: int | None = None) -> Engine:
    """Return an engine over ``worlds`` in which ``agent`` drives ``vehicle``, or a team drives its vehicles.

    The other vehicles follow their scripts. The agents decide when their first vehicle's latency has elapsed and every
    time step after that, like learners; their commands are applied without rounding. Behind a shield they propose
    commands, and the engine treats their vehicles as learners. An agent that looks ahead knows the scripts, and assumes
    that other controlled vehicles brake fully. Raises ``InvalidInput`` for a learner without an agent.
    """
    team = agent if isinstance(agent, Team) else Team.of(agent, () if vehicle is None else (vehicle,))
    drivers = team.drivers
    undriven = [scenario.vehicle_names[i] for i in scenario.learners if i not in drivers]
    if undriven:
        for_one = ", ".join(f"+{name}" for name in around_one_vehicle())
        raise InvalidInput(
            f"agent {team.name!r} drives {', '.join(scenario.vehicle_names[i] for i in drivers) or 'nobody'}, but"
            f" {', '.join(undriven)} of scenario {scenario.name!r} must be driven too. An agent that rolls itself out"
            f" ({for_one}) can drive one learner, the others need scripts"
        )
    scripts = script_agents(scenario, except_for=drivers)
    shield = team.shield
    if shield is None:
        engine = Engine(
            scenario, worlds.n, learners=(), scripts={**scripts, **drivers}, deciders=tuple(drivers), worlds=worlds
        )
    else:
        engine = Engine(
            scenario, worlds.n, learners=tuple(drivers), scripts=scripts, worlds=worlds,
            guard=lambda engine: shield.guard(engine, drivers),
        )  # fmt: skip
        engine.check_time_step(drivers)
    engine.roster.warns = False  # the caller of the loop checks for failed worlds
    return engine


def drive(
    worlds: Worlds, agent: Driver, scenario: Scenario, vehicle: int | None = None, *, watched_by: Sequence[Watch] = ()
) -> Episodes:
    """Let ``agent`` drive ``vehicle``, or a team its vehicles, in every world from t = 0 to the end of its episode.

    ``watched_by`` sees every step. Raises ``PhysicsError`` with all worlds that could not be advanced; the others are
    valid without them.
    """
    engine = episode_engine(worlds, agent, scenario, vehicle)
    return Episodes.of(engine, scenario.play_pieces(worlds, engine.deciders), watched_by)


def _show(watched_by: Sequence[Watch], before: Worlds, engine: Engine, command_mps2: Floats) -> Worlds:
    """Show the step that the engine has just made to the observers; return the worlds after it."""
    if not watched_by:
        return before
    now = engine.packed.worlds(before.vehicles)  # same episodes, same vehicles
    for part in engine.segments(before, command_mps2):
        for watch in watched_by:
            watch.see(*part)
    return now


def record_commands(agent: Driver, worlds: Worlds, scenario: Scenario, vehicle: int, steps: int) -> Floats:
    """Return the commands that ``agent`` gives ``vehicle`` in the first ``steps`` decisions, [n, steps] m/s2.

    ``worlds`` are at the alert. After the end of an episode its last command is repeated. Raises ``PhysicsError`` with
    the worlds that cannot be driven to the end.
    """
    engine = episode_engine(worlds, agent, scenario, vehicle)
    commands = write_down(engine, steps, lambda: engine.wanted_mps2[:, [vehicle]])[:, :, 0]
    latest = np.maximum.accumulate(np.where(np.isnan(commands), 0, np.arange(steps)), axis=1)
    filled: Floats = np.take_along_axis(commands, latest, axis=1)
    return filled


def write_down(engine: Engine, steps: int, column: Callable[[], Floats]) -> Floats:
    """Run an episode engine to the end; return ``column()`` [n, K] after each of the first steps, [n, steps, K].

    NaN after the end of an episode. Raises ``PhysicsError``.
    """
    columns = np.full((steps, *column().shape), np.nan)
    while not engine.ended.all():
        rows = np.flatnonzero(engine.steps < steps)
        at = engine.steps[rows]
        engine.step({})
        columns[at, rows] = column()[rows]
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    return columns.swapaxes(0, 1)
