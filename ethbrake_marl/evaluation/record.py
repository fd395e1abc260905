"""Record one episode with closely spaced samples, for figures and viewers.

A team drives as in an evaluation. Between two decisions the motion is computed again, from the state at the first one.
The record ends with the episode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ethbrake_marl.agents.drive import Team, play
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.measures import AT_REST, ended
from ethbrake_marl.evaluation.pushing import POST_M
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.drive import MET, drive
from ethbrake_marl.motion.layout import (
    FAR_M,
    FORCE,
    GAP,
    LATENCY,
    NEW_COUNT,
    NEW_FIRST,
    NEW_TOTAL,
    NEXT_CLOSING,
    NEXT_TIME,
    SPEED,
    Floats,
    Ints,
    scratch_for,
)

SAMPLE_S = 0.02  # usual time between two samples
OF_IMPACT = (NEXT_TIME, NEXT_CLOSING, NEW_COUNT, NEW_FIRST, NEW_TOTAL)


@large
def drive_each(line, car, wanted, start, until, scratch, rows, out):
    """Advance every world in place, and write ``rows`` of scratch memory to ``out`` [n, rows, N + 1]; 0 if apart."""
    for k in range(len(until)):
        met = drive(line[k], car[k], wanted[k], scratch, start[k], until[k])
        for r in range(len(rows)):
            for p in range(line.shape[2]):
                out[k, r, p] = scratch[rows[r], p] if met == MET else 0.0


@dataclass(frozen=True)
class Impacts:
    """Impacts of one episode in order of time; several of a pair within 0.02 s are one row."""

    time_s: Floats  # [m] of the first
    pair: Ints  # [m] 0: Vehicle 1 with the obstacle, p: vehicle_p and the one behind it
    closing_speed_mps: Floats  # [m] of the first
    number: Ints  # [m]
    first_impact_harm: Floats  # [m] m2/s2
    total_harm: Floats  # [m] m2/s2


@dataclass(frozen=True)
class EpisodeRecord:
    """Motion of one world at k times from the alert to the end of its episode.

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
    at_rest: bool  # whether the line came to rest before the horizon

    @property
    def initial(self) -> State:
        """The world at the alert."""
        return self.states[0]

    @property
    def last(self) -> State:
        """The state at the end, with the harm of the episode."""
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

    Samples are at most ``sample_s`` apart, and at every decision. Raises ``InvalidInput`` unless there is exactly one
    world at the alert, and for a ``sample_s`` that is not finite and above 0.
    """
    if world.n != 1 or world.time_s[0] != 0.0:
        raise InvalidInput(
            f"record_episode: world has {count_of(world.n, 'world')}; pass exactly 1 at the alert, for instance"
            " worlds.take([0])"
        )
    if not (isinstance(sample_s, int | float) and 0.0 < sample_s < math.inf):
        raise InvalidInput(f"record_episode: sample_s = {sample_s!r}: must be a finite number of seconds above 0")
    states = [world, *(state for _, state in play(game, world, team))]
    pieces = [_between(before, after, sample_s) for before, after in pairwise(states)]
    times, lines, wanted, impacts = (np.concatenate(part) for part in zip(*pieces, strict=True))
    way_m = np.cumsum(lines[:, 0, GAP, 0] - lines[:, 1, GAP, 0])  # of Vehicle 1, up to the end of each piece
    line = np.concatenate([lines[:, 0], lines[-1:, 1]])
    time_s = np.append(times[:, 0], times[-1, 1])
    front_m = np.append(0.0, way_m)
    behind_m = np.cumsum(line[:, GAP, 1:-1], axis=1)
    in_force = world.car[:, LATENCY, 1:] <= time_s[:, np.newaxis]
    last = states[-1]
    return EpisodeRecord(
        team.name, game.name, tuple(team.drivers), tuple(states), time_s, line[:, GAP, 1:-1], line[:, SPEED, 1:],
        np.column_stack([front_m, front_m[:, np.newaxis] - behind_m]),
        np.where(in_force, np.concatenate([wanted, wanted[-1:]]), 0.0), line[:, FORCE, 1:], _impacts(times, impacts),
        bool(np.asarray(ended(game, world, last))[0] == AT_REST),
    )  # fmt: skip


def _between(before: State, after: State, sample_s: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return k pieces of the motion between two states: times [k, 2], lines [k, 2, ...] at their beginning and end,

    commands [k, N], and rows OF_IMPACT [k, rows, N + 1]. Without an obstacle, a post measures the way of Vehicle 1.
    """
    start, end = float(before.time_s[0]), float(after.time_s[0])
    count = max(math.ceil((end - start) / sample_s - 1e-9), 1) if end > start else 0
    ends = np.linspace(start, end, count + 1)
    line = before.line.copy()
    line[:, GAP, 0] = np.where(line[:, GAP, 0] < FAR_M, line[:, GAP, 0], POST_M)
    every, scratch = np.zeros(count + 1, np.int64), scratch_for(line.shape[2])
    lines, car, wanted = line[every], before.car[every], after.wanted[every]
    rows, out = np.array(OF_IMPACT), np.empty((count + 1, len(OF_IMPACT), line.shape[2]))
    drive_each(lines, car, wanted, np.full(count + 1, start), ends, scratch, rows, out)
    lines[0] = line[0]
    drive_each(lines[:-1].copy(), car[:-1], wanted[:-1], ends[:-1].copy(), ends[1:].copy(), scratch, rows, out[:-1])
    times = np.column_stack([ends[:-1], ends[1:]])
    return times, np.stack([lines[:-1], lines[1:]], axis=1), wanted[:-1, 1:], out[:-1]


def _impacts(times: Floats, rows: Floats) -> Impacts:
    piece, pair = np.nonzero(rows[:, OF_IMPACT.index(NEW_COUNT)])
    of = {row: rows[piece, k, pair] for k, row in enumerate(OF_IMPACT)}
    time_s = times[piece, 0] + of[NEXT_TIME]
    order = np.argsort(time_s, kind="stable")
    return Impacts(
        time_s[order], pair[order], of[NEXT_CLOSING][order], of[NEW_COUNT][order].astype(np.int64),
        of[NEW_FIRST][order], of[NEW_TOTAL][order],
    )  # fmt: skip
