"""The motion between decisions, simulated again: records of episodes for figures and viewers, times of impacts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ethbrake_marl.agents.team import Team, play
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

SAMPLE_S = 0.02  # usual time between two samples
POST_M = 1e5  # distance to an imaginary post that no vehicle reaches; its gap gives distances to 1e-10 m


@dataclass(frozen=True)
class Impacts:
    """The m impacts of one episode, in order of time.

    If a pair has several impacts between two samples of the record, they are one entry.
    """

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
    >>> scenario, game = eb.open_game("paper-random")
    >>> team = eb.Team.of({"vehicle_2": eb.make_agent("full_brake")}, "full_brake")
    >>> record = eb.record_episode(scenario.sample(1, seed=7), team, game)
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

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
        """The world at the alert."""
        return self.states[0]

    @property
    def last(self) -> State:
        """The state at the end of the episode."""
        return self.states[-1]

    def __repr__(self) -> str:
        first, total = (float(self.last.harm(count)[0]) for count in ("first", "total"))
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(int(self.impacts.number.sum()), 'impact')}, harm {first:.2f}"
            f" first-impact, {total:.2f} total)"
        )


def record_episode(world: State, team: Team, game: Game, sample_s: float = SAMPLE_S) -> EpisodeRecord:
    """Let a team drive one world exactly as in ``evaluate``, and record the motion.

    Samples are at every decision, and at most ``sample_s`` apart. Raises ``InvalidInput`` unless there is exactly one
    world at the alert, and ``sample_s`` is finite and above 0.
    """
    if world.n != 1 or world.time_s[0] != 0.0:
        raise InvalidInput(
            f"record_episode: world has {count_of(world.n, 'world')}; pass exactly 1 at the alert, for instance"
            " worlds.take([0])"
        )
    if not (isinstance(sample_s, int | float) and 0.0 < sample_s < math.inf):
        raise InvalidInput(f"record_episode: sample_s = {sample_s!r}: must be a finite number of seconds above 0")
    return record_episodes(world, team, game, sample_s)[0]


def record_episodes(worlds: State, team: Team, game: Game, sample_s: float = SAMPLE_S) -> list[EpisodeRecord]:
    """Records of several worlds that a team drives, one per world, as by ``record_episode``."""
    require(game.marked(worlds), "a record of the motion between decisions", simulates=True)
    states = [worlds, *(state for _, state in play(game, worlds, team))]
    return [_record_of([state.take([row]) for state in states], team, game, sample_s) for row in range(worlds.n)]


def _record_of(states: list[State], team: Team, game: Game, sample_s: float) -> EpisodeRecord:
    """Record of one world, from its states at the alert and at every decision. States after the end are left out."""
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
    Without an obstacle, a post far ahead shows how far Vehicle 1 has moved.
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
    """Impacts in the pieces that ``_motion_pieces`` returns.

    A piece with impacts is simulated again to get time and closing speed of each pair's first.
    """
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
    """Copy of ``state.line`` with an imaginary post far ahead of Vehicle 1, except in worlds with an obstacle.

    The gap ahead of Vehicle 1 then shows how far the vehicle moves.
    """
    line = state.line.copy()
    line[:, GAP, 0] = np.where(line[:, GAP, 0] < FAR_M, line[:, GAP, 0], POST_M)
    return line


def advance_worlds(line: Floats, car: Floats, time: Floats, until: Floats, wanted: Floats, scratch: Floats) -> int:
    """Advance every world from ``time`` to ``until`` (s, [n] each); change ``line`` in place.

    Returns the index of a world in which the simulation failed, or -1. All vehicles hold the commands ``wanted`` [n, N
    + 1] (m/s2); the other arrays are described in ``motion.layout``.
    """
    moved = line.copy()  # arrays of any layout become alike, because a kernel is compiled for each layout
    failed: int = move_lines(moved, car.copy(), time.copy(), until.copy(), wanted.copy(), scratch)
    line[:] = moved
    return failed


def simulate_again(before: State, after: State, rows: Bools) -> Iterator[tuple[int, Floats]]:
    """Simulate the worlds in the mask ``rows`` [n] again, from ``before`` to ``after``, one after the other.

    Yields the index of each world, and the scratch memory that the physics has filled (``motion.layout``). There must
    be no decision between the two states.
    """
    require(before, "a quantity of single impacts", simulates=True)
    scratch = scratch_for(after.vehicles + 1)
    for k in np.flatnonzero(rows).tolist():
        line, car, wanted = (array[k].copy() for array in (before.line, before.car, after.wanted))
        move_line(line, car, wanted, scratch, before.time_s[k], after.time_s[k])
        yield k, scratch
