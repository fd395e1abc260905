"""The motion between decisions, simulated again: records of episodes for figures and viewers, times of impacts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ethbrake_marl.agent_names import open_game, require_learner, teams_of
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.counts import HONEST, IMPACT_COUNTS, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.motion.interval import move_line, move_lines
from ethbrake_marl.motion.layout import (
    FAR_M,
    FIRST,
    FORCE,
    GAP,
    IMPACTS,
    LATENCY,
    NEXT_CLOSING,
    NEXT_TIME,
    SPEED,
    TOTAL,
    Bools,
    Floats,
    Ints,
    scratch_for,
)
from ethbrake_marl.worlds.open_game import AnyScenario

SAMPLE_S = 0.02  # usual time between two samples
POST_M = 1e5  # distance to an imaginary post that no vehicle reaches; its gap gives distances to 1e-10 m


@dataclass(frozen=True)
class Impacts:
    """The m impacts of one episode, in order of time; those of a pair between two samples are one entry."""

    time_s: Floats  # [m] of the first impact in the entry
    pair: Ints  # [m] 0: Vehicle 1 with the obstacle, p: vehicle_p and the one behind it
    closing_speed_mps: Floats  # [m] of the first impact in the entry
    number: Ints  # [m] of impacts in the entry
    first_impact_harm: Floats  # [m] m2/s2
    total_harm: Floats  # [m] m2/s2


@dataclass(frozen=True)
class EpisodeRecord:
    """Motion of one world at k times, from the alert to the end of its episode.

    >>> import ethbrake_marl as eb
    >>> record = eb.record_episode("paper-random", "full_brake", number=1)
    >>> record.agent, record.gaps_m.shape, len(record.impacts.time_s)
    ('full_brake', (186, 2), 6)

    """

    agent: str
    scenario: str
    vehicles: tuple[int, ...]  # bodies that the team drives (1: Vehicle 1)
    states: tuple[State, ...]  # at the alert, at every decision, and at the end
    time_s: Floats  # [k] ascending
    gaps_m: Floats  # [k, N - 1]
    speeds_mps: Floats  # [k, N]
    positions_m: Floats  # [k, N] along the road from where Vehicle 1 is at the alert, as if vehicles had no length
    command_mps2: Floats  # [k, N] commanded from this time on; 0 before the latency is over
    forces_mps2: Floats  # [k, N] what brakes and engines cause
    impacts: Impacts
    at_rest: bool  # whether all vehicles stand at the end

    @property
    def initial(self) -> State:
        return self.states[0]

    @property
    def last(self) -> State:
        return self.states[-1]

    def __repr__(self) -> str:
        first, total = (float(self.last.harm(count)[0]) for count in IMPACT_COUNTS)
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(int(self.impacts.number.sum()), 'impact')}, harm {first:.2f}"
            f" first-impact, {total:.2f} total)"
        )


def record_episode(
    worlds: AnyScenario | State,
    agent: Any,
    *,
    scenario: AnyScenario | None = None,
    number: int = 0,
    seed: int = 7,
    harm_count: AnyCount = HONEST,
    sample_s: float = SAMPLE_S,
) -> EpisodeRecord:
    """Let one agent drive one world exactly as in ``evaluate``, and record the motion.

    Args:
        worlds: a scenario, or one world at the alert together with ``scenario``.
        agent: name of an agent, an agent, a team, or a mapping from vehicles to agents.
        scenario: scenario of the world, if ``worlds`` is one.
        number: number of the world in the scenario's evaluation list.
        seed: seed of the evaluation list.
        harm_count: what an optimising agent minimises (``episode.counts``).
        sample_s: longest time between two samples (s). There are also samples at every decision.

    Raises the errors of ``evaluate``, and ``InvalidInput`` unless there are one agent and one world at the alert.

    >>> import ethbrake_marl as eb
    >>> record = eb.record_episode("paper-random", "full_brake")
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

    """
    agents = agent if isinstance(agent, str) else {str(getattr(agent, "name", "agents")): agent}
    records = record_agents(
        worlds, agents, scenario=scenario, number=number, seed=seed, harm_count=harm_count, sample_s=sample_s
    )
    if len(records) != 1:
        raise InvalidInput(f"record_episode: agent {agent!r:.80} means {len(records)} agents; name one agent")
    return next(iter(records.values()))


def record_agents(
    worlds: AnyScenario | State,
    agents: Any,
    *,
    scenario: AnyScenario | None = None,
    number: int = 0,
    seed: int = 7,
    harm_count: AnyCount = HONEST,
    sample_s: float = SAMPLE_S,
) -> dict[str, EpisodeRecord]:
    """Record of each agent in one world, by name. ``agents`` as in ``evaluate``, the rest as in ``record_episode``."""
    if not (isinstance(sample_s, int | float) and 0.0 < sample_s < math.inf):
        raise InvalidInput(f"record_episode: sample_s = {sample_s!r}: must be a finite number of seconds above 0")
    count = HarmCount.of(harm_count, "record_episode: harm_count")
    if isinstance(worlds, State):
        if scenario is None:
            raise InvalidInput("record_episode: a world needs its scenario, for instance scenario='paper-random'")
        world, (loaded, game) = worlds, open_game(scenario, reward={"harm_count": count})
    else:
        if scenario is not None:
            raise InvalidInput("record_episode: scenario: is given twice; leave one of the two out")
        loaded, game = open_game(worlds, reward={"harm_count": count})
        world = loaded.sample(1, seed, first=number)
    require_learner(loaded)
    if world.n != 1 or world.time_s[0] != 0.0:
        raise InvalidInput(
            f"record_episode: worlds has {count_of(world.n, 'world')}; pass exactly 1 at the alert, for instance"
            " worlds.take([0])"
        )
    teams = teams_of(agents, loaded, harm_count=count)
    return {name: record_episodes(world, team, game, sample_s)[0] for name, team in teams.items()}


def record_episodes(worlds: State, team: Team, game: Game, sample_s: float = SAMPLE_S) -> list[EpisodeRecord]:
    """Records of several worlds that a team drives, one per world."""
    require(game.marked(worlds), "a record of the motion between decisions", simulates=True)
    states = [worlds, *(state for _, state in play(game, worlds, team))]
    return [_record_of([state.take([row]) for state in states], team, game, sample_s) for row in range(worlds.n)]


def _record_of(states: list[State], team: Team, game: Game, sample_s: float) -> EpisodeRecord:
    until = 2 + sum(not state.ended[0] for state in states[1:])
    states, world = states[:until], states[0]
    pieces = [_motion_pieces(before, after, sample_s) for before, after in pairwise(states)]
    times, lines, wanted = (np.concatenate(part) for part in zip(*pieces, strict=True))
    way_m = np.cumsum(lines[:, 0, GAP, 0] - lines[:, 1, GAP, 0])  # of Vehicle 1, up to the end of each piece
    line = np.concatenate([lines[:, 0], lines[-1:, 1]])
    time_s = np.append(times[:, 0], times[-1, 1])
    front_m = np.append(0.0, way_m)
    behind_m = np.cumsum(line[:, GAP, 1:-1], axis=1)
    in_force = world.car[:, LATENCY, 1:] <= time_s[:, np.newaxis]
    commands = np.concatenate([wanted, wanted[-1:]])[:, 1:]
    return EpisodeRecord(
        team.name, game.name, tuple(team.drivers), tuple(states), time_s, line[:, GAP, 1:-1], line[:, SPEED, 1:],
        np.column_stack([front_m, front_m[:, np.newaxis] - behind_m]),
        np.where(in_force, commands, 0.0), line[:, FORCE, 1:], _impacts(times, lines, world.car, wanted),
        not states[-1].moving[0],
    )  # fmt: skip


def _motion_pieces(before: State, after: State, sample_s: float) -> tuple[Floats, Floats, Floats]:
    """Motion of one world between two decisions, cut into k pieces of at most ``sample_s``.

    Returns times [k, 2] (s) and lines [k, 2, rows, N + 1] at both ends of each piece, and commands [k, N + 1] (m/s2).
    """
    start, end = float(before.time_s[0]), float(after.time_s[0])
    count = max(math.ceil((end - start) / sample_s - 1e-9), 1) if end > start else 0
    ends = np.linspace(start, end, count + 1)
    line = with_post(before)
    world_rows = np.zeros(count, np.int64)
    lines, wanted = line[world_rows], after.wanted[world_rows]
    advance_worlds(lines, before.car[world_rows], np.full(count, start), ends[1:], wanted, scratch_for(line.shape[2]))
    lines = np.concatenate([line, lines])
    return np.column_stack([ends[:-1], ends[1:]]), np.stack([lines[:-1], lines[1:]], axis=1), wanted


def _impacts(times: Floats, lines: Floats, car: Floats, wanted: Floats) -> Impacts:
    """Impacts in pieces of motion. A piece with impacts is simulated again for time and speed of each pair's first."""
    rows = [FIRST, TOTAL, IMPACTS]
    increase = lines[:, 1, rows] - lines[:, 0, rows]
    piece, pair = np.nonzero(increase[:, 2])
    firsts = np.empty((len(piece), 2))
    for row, (k, p) in enumerate(zip(piece, pair, strict=True)):
        scratch = scratch_for(car.shape[2])
        advance_worlds(lines[k : k + 1, 0].copy(), car, times[k, :1], times[k, 1:], wanted[k : k + 1], scratch)
        firsts[row] = times[k, 0] + scratch[NEXT_TIME, p], scratch[NEXT_CLOSING, p]
    order = np.argsort(firsts[:, 0], kind="stable")
    first, total, number = increase[piece, :, pair][order].T
    return Impacts(firsts[order, 0], pair[order], firsts[order, 1], number.astype(np.int64), first, total)


def with_post(state: State) -> Floats:
    """Copy of ``state.line`` with a post far ahead of Vehicle 1, if there is no obstacle: its gap shows how far it
    moves.
    """
    line = state.line.copy()
    line[:, GAP, 0] = np.where(line[:, GAP, 0] < FAR_M, line[:, GAP, 0], POST_M)
    return line


def advance_worlds(line: Floats, car: Floats, time: Floats, until: Floats, wanted: Floats, scratch: Floats) -> int:
    """Advance every world from ``time`` to ``until`` (s, [n] each) under the commands ``wanted``; change ``line`` in
    place.

    Returns the index of a world in which the simulation failed, or -1. ``motion.layout`` describes the arrays.
    """
    moved = line.copy()  # arrays of any layout become alike, because a kernel is compiled for each layout
    failed: int = move_lines(moved, car.copy(), time.copy(), until.copy(), wanted.copy(), scratch)
    line[:] = moved
    return failed


def simulate_again(before: State, after: State, rows: Bools) -> Iterator[tuple[int, Floats]]:
    """Simulate the worlds in the mask ``rows`` [n] again, between two states without a decision between them.

    Yields the index of each world, and the scratch memory of the physics (``motion.layout``).
    """
    require(before, "a quantity of single impacts", simulates=True)
    scratch = scratch_for(after.vehicles + 1)
    for k in np.flatnonzero(rows).tolist():
        line, car, wanted = (array[k].copy() for array in (before.line, before.car, after.wanted))
        move_line(line, car, wanted, scratch, before.time_s[k], after.time_s[k])
        yield k, scratch
