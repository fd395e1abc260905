"""One episode at fine time resolution: what a figure or a viewer draws.

Between decisions the motion follows from the state and the command alone, so the episode is first run as in an
evaluation, and then sampled inside its steps: every sample is advanced straight from the beginning of its step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.rollout import controlled_vehicle
from ethbrake_marl.evaluation.tape import Tape
from ethbrake_marl.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.scenario.schema import Scenario

SAMPLE_S = 0.02


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """One world from the alert to its end, at k times; row 0 is the alert.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> world = scenario.sample(1, seed=7).worlds
    >>> record = eb.record_episode(world, eb.make_agent("full_brake"), scenario=scenario)
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

    """

    agent: str  # its name
    scenario: Scenario  # of the world
    vehicle: int  # index (0 = front) of the vehicle that the agent drove
    initial: Worlds  # n = 1, at the alert
    time_s: Floats  # [k] since Vehicle 1 began to brake, ascending
    gaps_m: Floats  # [k, P]
    speeds_mps: Floats  # [k, N]
    positions_m: Floats  # [k, N] front bumpers along the road; a vehicle's length is not counted
    command_mps2: Floats  # [k, N] signed acceleration asked for from then on; 0 before the latency has elapsed
    impacts: ImpactRows  # in order of time; world is 0
    ledger: Ledger  # n = 1
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    def __repr__(self) -> str:
        first, total = (float(self.ledger.world_harm(harm_count)[0]) for harm_count in HARM_COUNTS)
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario.name!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(len(self.impacts.time_s), 'impact')}, harm {first:.2f} first-impact,"
            f" {total:.2f} total)"
        )


def record_episode(
    world: Worlds, agent: Agent, *, scenario: Scenario, vehicle: int | str | None = None, sample_s: float = SAMPLE_S
) -> EpisodeRecord:
    """Record one world from the alert on, exactly as ``evaluate`` runs it.

    Args:
        world: at the alert, n = 1.
        agent: drives one vehicle; it is left as it is.
        scenario: of the world; its scripts drive the other vehicles.
        vehicle: the one that is driven, by name (``vehicle_2``) or index (0 = front); None: the scenario's only
            learner.
        sample_s: samples lie at most so far apart (s), and at every decision.

    Raises ``InvalidInput`` for more than one world or ``sample_s`` not above 0.

    """
    if world.n != 1:
        raise InvalidInput(
            f"record_episode: {count_of(world.n, 'world')} given; exactly 1 is needed, for instance worlds.take([0])"
        )
    if not (sample_s > 0.0 and math.isfinite(sample_s)):
        raise InvalidInput(f"record_episode: sample_s = {sample_s}; must be finite and above 0")
    driven = controlled_vehicle(scenario, vehicle)
    tape = Tape(world)
    episodes = drive(world, agent, scenario, driven, watched_by=[tape])
    samples = list(_samples(tape.steps, sample_s))
    time, gaps, speeds, positions, command = (np.concatenate(column) for column in zip(*samples, strict=True))
    return EpisodeRecord(
        agent.name, scenario, driven, world, time, gaps, speeds, positions, command, tape.episodes().rows,
        episodes.ledger, bool(episodes.at_rest[0]),
    )  # fmt: skip


def _samples(segments: Sequence[tuple[Worlds, Floats, Floats]], sample_s: float) -> Iterator[tuple[Floats, ...]]:
    """Rows of (time, gaps, speeds, positions, command from then on), segment by segment, the last with its end.

    Worlds know gaps and speeds only. An obstacle ahead of Vehicle 1, the world's own or one that is out of reach, makes
    its position one more gap.
    """
    front = 0.0  # position of Vehicle 1 at the start of the segment
    for number, (before, command, until_s) in enumerate(segments):
        start, end = float(before.time_s[0]), float(until_s[0])
        count = max(math.ceil((end - start) / sample_s - 1e-9), 1) if end > start else 0
        times = np.linspace(start, end, count + 1)
        post = before.with_post_ahead(np.array([end - start]))
        copies = post.take(np.zeros(count + 1, np.int64))
        moved, _ = advance(copies, command, until_s=times)
        position, gaps, speeds = front + (post.obstacle_gap_m - moved.obstacle_gap_m), moved.gaps_m, moved.speeds_mps
        wanted = before.vehicles.piece_commands(command, times)
        in_force = np.where(before.vehicles.latency_s <= times[:, np.newaxis], wanted, 0.0)
        rows = slice(None) if number == len(segments) - 1 else slice(count)
        columns = (times, gaps, speeds, line_positions(position, gaps), in_force)
        yield tuple(column[rows] for column in columns)
        front = float(position[-1])


def line_positions(front: Floats, gaps: Floats) -> Floats:
    """Positions [k, N] from those of Vehicle 1 [k] and the gaps [k, P]."""
    return np.concatenate([front[:, np.newaxis], front[:, np.newaxis] - np.cumsum(gaps, axis=1)], axis=1)
