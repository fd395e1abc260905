"""Record of one episode with closely spaced time samples, for figures and viewers.

The agent first drives the episode as in an evaluation. After the episode, the state at each sample time is computed
from the state and the commands at the beginning of the time step that contains the sample time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.evaluation.rollout import controlled_vehicle
from ethbrake_marl.first_edition.evaluation.tape import Tape
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, Ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

SAMPLE_S = 0.02  # default time between two samples (s)


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """Motion of one world from the alert to the end of its episode, at k times, the first of which is the alert.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> world = scenario.sample(1, seed=7).worlds
    >>> record = eb.record_episode(world, eb.make_agent("full_brake"), scenario=scenario)
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

    """

    agent: str  # name of the agent
    scenario: Scenario  # scenario of the world
    vehicles: tuple[int, ...]  # indices (0 = front) of the controlled vehicles
    initial: Worlds  # the world at the alert, n = 1
    time_s: Floats  # [k] time since the alert, ascending
    gaps_m: Floats  # [k, P] gap of each pair
    speeds_mps: Floats  # [k, N] speed of each vehicle
    positions_m: Floats  # [k, N] position of each vehicle along the road, as if vehicles had no length
    command_mps2: Floats  # [k, N] commanded acceleration from this time on; 0 before the latency has elapsed
    impacts: ImpactRows  # all impacts in order of time; column ``world`` is 0
    ledger: Ledger  # harm of all impacts of the episode, n = 1
    at_rest: bool  # whether the line came to rest before the horizon

    @property
    def vehicle(self) -> int:
        """Index (0 = front) of the only controlled vehicle; raises ``InvalidInput`` if there are several."""
        return Task(self.scenario, self.vehicles).vehicle

    def __repr__(self) -> str:
        first, total = (float(self.ledger.world_harm(harm_count)[0]) for harm_count in HARM_COUNTS)
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario.name!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(len(self.impacts.time_s), 'impact')}, harm {first:.2f} first-impact,"
            f" {total:.2f} total)"
        )


def record_episode(
    world: Worlds, agent: Driver, *, scenario: Scenario, vehicle: int | str | None = None, sample_s: float = SAMPLE_S
) -> EpisodeRecord:
    """Let an agent drive one world exactly as in ``evaluate``, and record the motion.

    Args:
        world: the world at the alert, n = 1.
        agent: agent or team. The object that you pass does not change.
        scenario: scenario of the world, whose scripts drive the other vehicles.
        vehicle: the controlled vehicle, by name (``vehicle_2``) or index (0 = front); None: the scenario's learners.
        sample_s: largest time between two consecutive samples (s). The state at each decision is always sampled.

    Raises ``InvalidInput`` if ``world`` does not contain exactly one world, or if ``sample_s`` is not finite and above
    0.

    """
    if world.n != 1:
        raise InvalidInput(
            f"record_episode: world has {count_of(world.n, 'world')}; pass exactly 1, for instance worlds.take([0])"
        )
    if not (sample_s > 0.0 and math.isfinite(sample_s)):
        raise InvalidInput(f"record_episode: sample_s = {sample_s}: must be a finite number of seconds above 0")
    several = vehicle is None and len(scenario.learners) > 1
    vehicles = scenario.learners if several else (controlled_vehicle(scenario, vehicle),)
    tape = Tape(world)
    episodes = drive(world, Team.of(agent, vehicles), scenario, watched_by=[tape])
    samples = list(_samples(tape.steps, sample_s))
    time, gaps, speeds, positions, command = (np.concatenate(column) for column in zip(*samples, strict=True))
    return EpisodeRecord(
        agent.name, scenario, vehicles, world, time, gaps, speeds, positions, command, tape.episodes().rows,
        episodes.ledger, bool(episodes.at_rest[0]),
    )  # fmt: skip


def _samples(segments: Sequence[tuple[Worlds, Floats, Floats]], sample_s: float) -> Iterator[tuple[Floats, ...]]:
    """Yield the samples of each step: time [k], gaps [k, P], speeds [k, N], positions [k, N], commands [k, N].

    ``segments`` are the steps of one episode (``Tape.steps``). The state at the end of a step is returned only once: as
    the first sample of the next step or, for the last step, as the last sample of the episode. A world does not contain
    positions, so Vehicle 1's position is computed from its gap to an obstacle. For this computation, an obstacle is put
    into a world without an obstacle, so far ahead that Vehicle 1 cannot reach it.
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
    """Return the positions [k, N] of all vehicles from Vehicle 1's position ``front`` [k] and the gaps [k, P]."""
    return np.concatenate([front[:, np.newaxis], front[:, np.newaxis] - np.cumsum(gaps, axis=1)], axis=1)
