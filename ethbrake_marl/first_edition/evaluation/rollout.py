"""Evaluate agents: draw a fixed list of worlds, let every agent drive each world once, and measure the results.

The worlds of an evaluation are fixed in advance. If instead the episodes that finish first were evaluated, short
episodes would be over-represented, and many short episodes are crashes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import (
    AgentFailed,
    InvalidInput,
    check_one_learner,
    check_whole_number,
    renumbered,
    unknown_name,
)
from ethbrake_marl.first_edition.agents.driving import Episodes, drive, script_agents
from ethbrake_marl.first_edition.agents.protocol import Driver, Knowledge, Team, check_agent
from ethbrake_marl.first_edition.engine.stream import check_alert
from ethbrake_marl.first_edition.evaluation.aftermath import SampledHarm, ShovedFront
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.familiar import warn_unfamiliar
from ethbrake_marl.first_edition.evaluation.identity import CHUNK, EPISODES, LIST_SEED, policies_of
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.outcome import LeftOut, Outcome
from ethbrake_marl.first_edition.evaluation.own_measures import measure_columns
from ethbrake_marl.first_edition.evaluation.tape import Tape
from ethbrake_marl.first_edition.game.measures import REPORTED
from ethbrake_marl.first_edition.physics.left_out import leaving_out_failed
from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

OnWorlds = Callable[[str, int], None]  # called with an agent's name and the number of worlds that it has driven so far


def evaluate(
    worlds: Worlds | Sample | None = None,
    agents: str | Sequence[str] | Mapping[str, Driver] = (),
    *,
    scenario: str | Path | Scenario,
    vehicle: int | str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    chunk: int | None = None,
    on_progress: OnWorlds | None = None,
    aftermath: bool = True,
) -> Evaluation:
    """Let each agent drive every world once, from the alert to the end of the episode.

    Vehicles that no agent controls follow the scenario's scripts. The outcome in a world does not depend on other
    worlds. If the simulation of a world fails with one agent, the world is left out for all agents (``left_out``).

    Args:
        worlds: worlds at the alert, or a sample from ``scenario.sample``; None: draw ``episodes`` worlds from ``seed``.
        agents: specs as on the command line (``"full_brake,ppo"``, or a list of specs), or a mapping from name to agent
            or ``Team``. Each controlled vehicle gets a copy of its agent; the objects that you pass do not change.
            Optimising agents that are built from specs minimise first-impact harm.
        scenario: scenario of the worlds, or its name or path.
        vehicle: the controlled vehicle, by name (``vehicle_2``) or index (0 = front); None: the scenario's learners.
        episodes: number of worlds to draw; None: 10,000.
        seed: seed from which the worlds are drawn; None: 7. If ``worlds`` is passed, the seed is only recorded in the
            result.
        chunk: number of worlds that are simulated together, which does not affect the results; None: 2,500.
        on_progress: called after each chunk with an agent's name and the number of worlds that it has driven so far.
        aftermath: whether to also measure how far Vehicle 1 is shoved, the paper's sampled harm, and measures that the
            user registered. This takes longer.

    Warns (``Unfamiliar``) about policies that drive in worlds unlike their training worlds. Raises ``PhysicsError`` if
    every world is left out, and ``InvalidInput`` for worlds of another scenario, for worlds that are not at the alert,
    and for agents that do not fit the controlled vehicles.

    """
    scenario = load_scenario(scenario)
    if isinstance(agents, Sequence):
        agents = make_lineup(agents, scenario)
    if worlds is None:
        seed = LIST_SEED if seed is None else seed
        worlds = scenario.sample(EPISODES if episodes is None else episodes, seed=seed)
    elif episodes is not None:
        raise InvalidInput(f"evaluate: episodes = {episodes!r}: pass either worlds or episodes, not both")
    _check_request(worlds, agents, chunk)
    sample = worlds if isinstance(worlds, Sample) else Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0)
    if not sample.worlds.n:
        raise InvalidInput("evaluate: worlds is empty; pass at least one world")
    check_alert(sample.worlds, sample.worlds.n, scenario.vehicles)
    vehicles = controlled_vehicles(scenario, vehicle, agents)
    warn_unfamiliar(agents, sample.worlds, scenario, vehicles)
    parts = []
    for first, part in chunks_of(sample, chunk or CHUNK):
        parts.append(drive_chunk(part, agents, scenario, seed, vehicles, first, aftermath))
        if on_progress is not None:
            for name in agents:
                on_progress(name, first + part.worlds.n)
    return replace(Evaluation.join(parts), rejected=sample.rejected)


def chunks_of(sample: Sample, size: int = CHUNK) -> Iterator[tuple[int, Sample]]:
    """Yield chunks of at most ``size`` worlds as pairs (index in the sample of the chunk's first world, chunk)."""
    for first in range(0, sample.worlds.n, size):
        yield first, sample.take(np.arange(first, min(first + size, sample.worlds.n)))


def drive_chunk(
    sample: Sample,
    agents: Mapping[str, Driver],
    scenario: Scenario,
    seed: int | None,
    vehicles: tuple[int, ...],
    first: int = 0,
    aftermath: bool = True,
) -> Evaluation:
    """Let each agent drive all worlds of one chunk at once, from the alert to the end of their episodes.

    ``vehicles`` are the indices (0 = front) of the controlled vehicles. ``first`` is the position of the chunk's first
    world among all evaluated worlds (from 0), for error messages. ``seed`` and ``aftermath`` are as in ``evaluate``. If
    the simulation of every world fails, the returned ``Evaluation`` contains no world.
    """
    n, others = sample.worlds.n, [script.name for script in script_agents(scenario, except_for=vehicles).values()]
    outcomes: dict[str, Outcome] = {}
    advanced: dict[str, Ints] = {}  # name of an agent -> rows of the worlds in its outcome
    lost, rejected = dict[int, LeftOut](), sample.rejected
    for name, agent in agents.items():
        roll_out = partial(_roll_out, sample.worlds, agent, vehicles, scenario, aftermath)
        with AgentFailed.naming(name, others), renumbered(range(first, first + n)):
            outcome, advanced[name], failed = leaving_out_failed(roll_out, np.arange(n))
        if outcome is not None:
            outcomes[name] = outcome
        lost = {row: LeftOut(int(sample.index[row]), seed, name, why) for row, why in failed.items()} | lost
    if lost:
        good = np.setdiff1d(np.arange(n), list(lost))
        sample = sample.take(good)
        outcomes = {name: outcome.take(np.isin(advanced[name], good)) for name, outcome in outcomes.items()}
    left_out = tuple(lost[row] for row in sorted(lost))
    return Evaluation(
        scenario, vehicles, sample.worlds, sample.index, seed, outcomes, left_out=left_out, kinds=sample.kinds,
        rejected=rejected,
    )  # fmt: skip


def _check_request(worlds: object, agents: object, chunk: object) -> None:
    """Raise ``InvalidInput`` for invalid arguments of ``evaluate``."""
    if not isinstance(worlds, Worlds | Sample):
        raise InvalidInput(
            f"evaluate: worlds = {worlds!r}: must be a Worlds or Sample object, for instance scenario.sample(100,"
            " seed=7)"
        )
    if not isinstance(agents, Mapping):
        raise InvalidInput(
            f"evaluate: agents = {agents!r}: must be specs such as 'full_brake,ppo', or a mapping from name to agent"
        )
    if not agents:
        raise InvalidInput("evaluate: agents is empty; pass at least one agent, for instance 'full_brake'")
    for name, agent in agents.items():
        check_agent(agent, f"evaluate: agent {name!r}", alone=False)
        Knowledge.of(agent)  # raises for an invalid ``knows``
    if chunk is not None:
        check_whole_number("evaluate: chunk", chunk, 1)


def controlled_vehicles(scenario: Scenario, vehicle: int | str | None, agents: Mapping[str, Driver]) -> tuple[int, ...]:
    """Return the indices (0 = front) of the vehicles that the agents are to control.

    They are ``vehicle`` (name or index) or, if ``vehicle`` is None, all learners of the scenario. If ``vehicle`` is
    None and the scenario has no learner, the result is empty, provided that all agents are teams; otherwise
    ``InvalidInput`` is raised.
    """
    if vehicle is not None or (not scenario.learners and any(not isinstance(a, Team) for a in agents.values())):
        return (controlled_vehicle(scenario, vehicle),)
    return scenario.learners


def controlled_vehicle(scenario: Scenario, vehicle: int | str | None) -> int:
    """Return the index (0 = front) of the single controlled vehicle.

    The controlled vehicle is ``vehicle`` (name or index) or, if ``vehicle`` is None, the scenario's only learner.
    Raises ``InvalidInput`` if ``vehicle`` is None and the scenario does not have exactly one learner, or if any vehicle
    except ``vehicle`` is a learner.
    """
    learners = scenario.learners
    names = [scenario.vehicle_names[i] for i in learners]
    if vehicle is None:
        check_one_learner(scenario.name, names, "name the vehicle that the agents drive, for instance vehicle_2")
        return learners[0]
    if isinstance(vehicle, str):
        if vehicle not in scenario.vehicle_names:
            raise unknown_name("vehicle", vehicle, scenario.vehicle_names)
        vehicle = scenario.vehicle_names.index(vehicle)
    if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < scenario.vehicles:
        raise InvalidInput(
            f"vehicle = {vehicle!r}: must be the name of a vehicle, or an index from 0 to {scenario.vehicles - 1}"
        )
    if set(learners) - {vehicle}:
        raise InvalidInput(
            f"scenario {scenario.name!r} has the learners {', '.join(names)}, but vehicle ="
            f" {scenario.vehicle_names[vehicle]} is the only controlled vehicle; give a script to every other"
            " learner (scenario.replace(roles=...))"
        )
    return int(vehicle)


def _roll_out(
    whole: Worlds, agent: Driver, vehicles: tuple[int, ...], scenario: Scenario, aftermath: bool, rows: Ints
) -> Outcome:
    """Let copies of ``agent`` drive the worlds of ``whole`` with the row numbers ``rows``."""
    team = Team.of(agent, vehicles)
    worlds = scenario.play_pieces(whole.take(rows), tuple(team.drivers))
    task = Task(scenario, tuple(team.drivers))
    shoved = ShovedFront.of(worlds, task) if aftermath else None
    sampled = SampledHarm.of(worlds, task) if aftermath else None
    by_step = [measure.name for measure in REPORTED.values() if measure.by == "step" and aftermath]
    impacts = Tape(worlds, steps=False) if aftermath and len(REPORTED) > len(by_step) else None
    watches = [w for w in (shoved, sampled, impacts) if w is not None]
    episodes = drive(worlds, team, scenario, watched_by=watches, summed=by_step)
    outcome = outcome_of(team, episodes)
    return replace(
        outcome,
        shoved_m=None if shoved is None else shoved.metres,
        sampled_harm=None if sampled is None else sampled.finish(),
        metrics=measure_columns(episodes.terms, None if impacts is None else impacts.episodes()) if aftermath else {},
    )


def outcome_of(team: Team, episodes: Episodes) -> Outcome:
    """Return the ``Outcome`` of a team's episodes, without ``shoved_m``, ``sampled_harm`` and ``metrics``.

    ``predicted_harm`` and ``chosen_policy`` come from the shield's memory or, if the team has a single vehicle and no
    shield, from the agent's memory.
    """
    memory: Any = next(iter(episodes.memories.values()), None) if len(team.drivers) == 1 else None
    if episodes.guarded is not None:
        memory = episodes.guarded.results
    predicted, chosen = (
        _read_column(team, memory, what, episodes.final.n) for what in ("predicted_harm", "chosen_policy")
    )
    return Outcome(
        episodes.ledger,
        episodes.final,
        episodes.at_rest,
        None if predicted is None else predicted.astype(np.float64),
        None if chosen is None else chosen.astype(np.bool_),
        Knowledge.of(team),
        policies=policies_of(team.drivers),
    )


def _read_column(team: Team, memory: Any, what: str, n: int) -> NDArray[np.generic] | None:
    """Return the entry ``what`` of an agent's memory, [n], or None if there is no such entry."""
    value = memory.get(what) if isinstance(memory, Mapping) else None
    if value is None:
        return None
    column = np.asarray(value)
    if column.shape != (n,) or column.dtype.kind not in "biuf":
        raise InvalidInput(
            f"agent {team.name!r}: {what} in its memory has type {column.dtype} and shape {column.shape}; must be one"
            f" number per world, shape ({n},)"
        )
    return column
