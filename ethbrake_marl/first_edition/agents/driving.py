"""Let agents drive through whole episodes. Evaluations and rollouts use this module.

Arguments that several functions share:

- ``worlds``: n worlds at the alert.
- ``agent``: an agent that drives ``vehicle``, or a team, whose attribute ``drivers`` states which vehicles it drives.
- ``vehicle``: index of the vehicle that the agent drives (0 = front); None for a team.
- ``scenario``: scenario whose scripts drive the other vehicles.
- ``watched_by``: observers (``Watch``).
- ``summed``: names of reward terms to sum over each episode.

Functions that run episodes raise ``PhysicsError``, which names the worlds, if the physics failed in some worlds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.first_edition.agents.making import make_role
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Team
from ethbrake_marl.first_edition.agents.registry import around_one_vehicle
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.memory import Memory
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario


@dataclass(frozen=True, slots=True)
class Episodes:
    """Result of a batch of n whole episodes, one in each world."""

    ledger: Ledger  # harm and impacts of every pair of vehicles over the whole episode
    final: Worlds  # state of each world at the end of its episode
    at_rest: Bools  # [n] whether all vehicles came to rest; otherwise the episode ended at the horizon
    guarded: Any  # memory of the shield at the end; None without a shield
    memories: Mapping[int, Memory]  # index of a controlled vehicle -> memory of its agent at the end
    terms: Mapping[str, Floats] = field(default_factory=dict)  # name of a reward term -> its sum, [n] or [n, N]

    @classmethod
    def of(
        cls, engine: Engine, worlds: Worlds, watched_by: Sequence[Watch] = (), summed: Sequence[str] = ()
    ) -> Episodes:
        """Let an engine run from the first decision until the episodes in all worlds have ended.

        ``engine`` was made by ``episode_engine`` and has not made a step yet. The first call of each observer gets
        ``worlds``, the engine's worlds at the alert, as ``before``.
        """
        at_rest = np.zeros(worlds.n, np.bool_)
        terms: dict[str, Floats] = {}
        now = _show(watched_by, worlds, engine, engine.worlds.command_mps2)
        standing = engine.ended
        while not standing.all():
            step = engine.step({})
            at_rest |= step.terminated
            for name in summed:
                term = step.terms[name]
                running = np.where(standing if term.ndim == 1 else standing[:, np.newaxis], 0.0, term)
                terms[name] = terms.get(name, 0.0) + running
            now = _show(watched_by, now, engine, engine.wanted_mps2.copy())
            standing = engine.ended
        if engine.roster.failed:
            raise PhysicsError(engine.roster.failed)
        memories = {i: memory for i, memory in engine.memories.items() if i in engine.deciders}
        return cls(engine.ledger, engine.worlds, at_rest, engine.guarded, memories, terms)


class Watch(Protocol):
    """Observer, whose method ``see`` is called after every step of a batch of episodes."""

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Receive how the vehicles of all n worlds have moved during one time interval.

        The first step lasts from the alert to the first decision. If a script decides in the middle of a step, the step
        consists of several intervals, and this method is called once for each interval. The method must not change the
        arguments.

        Args:
            before: the worlds at the start of the interval.
            command_mps2: command of every vehicle during the interval, [n, N] m/s2.
            until_s: time of each world at the end of the interval, [n] s since the alert. After the end of an episode,
                the time of its world does not change.

        """
        ...


def script_agents(scenario: Scenario, *, except_for: int | Collection[int] | None = None) -> dict[int, Agent]:
    """Return a mapping from the index of each scripted vehicle of a scenario (0 = front) to its agent.

    ``except_for`` is the index or indices of vehicles to leave out.
    """
    left_out = (except_for,) if isinstance(except_for, int) else except_for or ()
    return {i: make_role(scenario, i) for i in scenario.scripts if i not in left_out}


def episode_engine(
    worlds: Worlds, agent: Driver, scenario: Scenario, vehicle: int | None = None, reward: Reward = "harm"
) -> Engine:
    """Return an engine in which agents drive whole episodes; call ``engine.step({})`` until all episodes have ended.

    The agents decide for the first time as soon as the latency of one controlled vehicle has elapsed, and then at every
    time step, like learners. The engine executes the agents' commands without rounding them. If the team has a shield,
    the agents only propose commands, and the engine treats the controlled vehicles as learners. An agent that looks
    ahead knows the scripts, and assumes that other controlled vehicles brake fully. The engine computes the terms of
    ``reward`` in every step.

    Raises ``InvalidInput`` if ``agent`` does not drive every learner of the scenario.
    """
    team = agent if isinstance(agent, Team) else Team.of(agent, () if vehicle is None else (vehicle,))
    drivers = team.drivers
    undriven = [scenario.vehicle_names[i] for i in scenario.learners if i not in drivers]
    if undriven:
        for_one = ", ".join(f"+{name}" for name in around_one_vehicle())
        raise InvalidInput(
            f"agent {team.name!r} drives {', '.join(scenario.vehicle_names[i] for i in drivers) or 'no vehicle'}, but"
            f" {', '.join(undriven)} of scenario {scenario.name!r} must have an agent as well. An agent with {for_one}"
            " can drive only one learner; give the other learners scripts"
        )
    scripts = script_agents(scenario, except_for=drivers)
    shield = team.shield
    if shield is None:
        engine = Engine(
            scenario, worlds.n, learners=(), scripts={**scripts, **drivers}, reward=reward, deciders=tuple(drivers),
            worlds=worlds,
        )  # fmt: skip
    else:
        engine = Engine(
            scenario, worlds.n, learners=tuple(drivers), scripts=scripts, reward=reward, worlds=worlds,
            guard=lambda engine: shield.guard(engine, drivers),
        )  # fmt: skip
        engine.check_time_step(drivers)
    engine.roster.warns = False  # the caller of the loop checks for failed worlds
    return engine


def drive(
    worlds: Worlds, agent: Driver, scenario: Scenario, vehicle: int | None = None, *,
    watched_by: Sequence[Watch] = (), summed: Sequence[str] = (),
) -> Episodes:  # fmt: skip
    """Let an agent or a team drive in every world from the alert (t = 0) to the end of its episode.

    The terms in ``summed`` have the default settings of ``RewardParams``. After a ``PhysicsError``, a new call without
    the worlds that it names succeeds.
    """
    reward: Reward = {"harm": 1.0} | dict.fromkeys(summed, 1.0) if summed else "harm"
    engine = episode_engine(worlds, agent, scenario, vehicle, reward)
    return Episodes.of(engine, scenario.play_pieces(worlds, engine.deciders), watched_by, summed)


def _show(watched_by: Sequence[Watch], before: Worlds, engine: Engine, command_mps2: Floats) -> Worlds:
    """Pass the engine's last step, with the vehicles' commands, to the observers; return the worlds after the step.

    Without observers, the function does nothing and returns ``before``.
    """
    if not watched_by:
        return before
    now = engine.packed.worlds(before.vehicles)
    for part in engine.segments(before, command_mps2):
        for watch in watched_by:
            watch.see(*part)
    return now


def record_commands(agent: Driver, worlds: Worlds, scenario: Scenario, vehicle: int, steps: int) -> Floats:
    """Return the commands of ``agent`` for ``vehicle`` in the first ``steps`` steps, [n, steps] m/s2.

    If an episode has fewer than ``steps`` steps, the last command of the episode is repeated in the remaining steps.
    """
    engine = episode_engine(worlds, agent, scenario, vehicle)
    commands = write_down(engine, steps, lambda: engine.wanted_mps2[:, [vehicle]])[:, :, 0]
    latest = np.maximum.accumulate(np.where(np.isnan(commands), 0, np.arange(steps)), axis=1)
    filled: Floats = np.take_along_axis(commands, latest, axis=1)
    return filled


def write_down(engine: Engine, steps: int, column: Callable[[], Floats]) -> Floats:
    """Let an engine run to the end of all episodes; record K numbers per world after each of the first ``steps`` steps.

    ``engine`` was made by ``episode_engine``. ``column`` returns the K numbers to record for each of n worlds, [n, K].
    Returns the recorded numbers, [n, steps, K]. The numbers of a world after the end of its episode are NaN.
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
