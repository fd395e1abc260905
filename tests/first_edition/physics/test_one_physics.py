"""One physics: engine, ``advance``, search and shield move a line alike, to the bit, and as small steps of time do.

Lines are random: rates finite, infinite and unequal, latencies at, before and after decisions, pieces, wet roads, an
obstacle, one to three learners with random actions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.scripts import StateFree
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, Profiles, profile_problem
from ethbrake_marl.first_edition.game.actions import action_to_command
from ethbrake_marl.first_edition.game.harm import HarmCount, Ledger, empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds, make_worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.certify import plan_harm
from ethbrake_marl.first_edition.shields.running import begin_running
from tests.first_edition.physics.random_worlds import Draws
from tests.first_edition.physics.test_build_up import Pieces, by_small_steps

STEP_S, HORIZON_S = 0.1, 4.0


class Lines(NamedTuple):
    """Random lines, as arguments of ``make_worlds``, and the actions of their learners."""

    given: dict[str, Floats]
    learners: tuple[int, ...]
    pieces: Pieces
    first_s: float  # of all decisions
    actions: Floats  # [n, T, L]

    @property
    def worlds(self) -> Worlds:
        return make_worlds(**self.given).play_pieces(self.pieces)

    @property
    def times_s(self) -> list[float]:
        """Of the decisions, and the horizon."""
        return [*(self.first_s + step * STEP_S for step in range(self.actions.shape[1])), HORIZON_S]


def random_lines(
    key: int, n: int, N: int, learners: tuple[int, ...], *, obstacle: bool = False, in_pieces: bool = False
) -> Lines:
    """Lines whose latencies elapse at a decision in half of the vehicles, else an ulp or part of a step beside one."""
    draws = Draws(9_000 + key)

    def rates() -> Floats:
        """Infinite ones of the whole batch by vehicle, so that each mix of both rates is there."""
        finite = np.exp(draws.uniform(1.0, 4.5, (n, N)))
        return np.where(draws.uniform(0.0, 1.0, (n, N)) < 0.4, np.inf, finite)

    first_s = float(draws.choice([0.2, 0.3, 0.5], (1,))[0])
    late = first_s + STEP_S * draws.choice([0, 1, 2, 3, 5], (n, N))
    beside = draws.choice([0.0, 0.0, 0.0, 1e-16, -1e-16, 0.04, -0.03], (n, N))
    latency = np.maximum(np.round(late, 12) + beside, 0.0)
    latency[:, 0] = np.where(draws.uniform(0.0, 1.0, (n,)) < 0.7, 0.0, latency[:, 0])
    latency[:, list(learners)] = np.maximum(latency[:, list(learners)], first_s)
    latency[:, learners[0]] = first_s
    friction = draws.choice([0.3, 0.6, 1.0], (n, 1))
    given = {
        "gaps_m": draws.uniform(0.3, 12.0, (n, N - 1)),
        "speeds_mps": draws.uniform(5.0, 22.0, (n, N)),
        "braking_capacity_mps2": np.minimum(draws.uniform(3.0, 9.0, (n, N)), friction * 9.81),
        "driving_capacity_mps2": np.minimum(draws.uniform(1.0, 6.0, (n, N)), friction * 9.81),
        "latency_s": latency,
        "mass_t": np.exp(draws.uniform(0.0, 3.0, (n, N))),
        "restitution": draws.choice([0.0, 0.1, 0.4], (n,)),
        "speed_limit_mps": draws.choice([23.0, 40.0], (n, N)),
        "brake_rate_mps3": rates(),
        "release_rate_mps3": rates(),
    }  # fmt: skip
    if obstacle:
        given["obstacle_gap_m"] = draws.uniform(5.0, 60.0, (n,))
    pieces: Pieces = {}
    if in_pieces:
        given["latency_s"] = np.maximum(np.round(given["latency_s"], 3), 0.0)
        most = given["braking_capacity_mps2"].min(axis=0)
        for i in set(range(N)) - set(learners):
            pieces[i] = [(0.0, round(0.4 * most[i], 3)), (0.3, round(0.99 * most[i], 3)), (1.234, 0.0)]
    steps = int(np.ceil((HORIZON_S - first_s) / STEP_S - 1e-9))
    actions = draws.choice([-1.0, -1.0, -0.4, 0.0, 0.5, 1.0], (n, steps, len(learners)))
    return Lines(given, learners, pieces, first_s, actions)


def scenario_of(lines: Lines) -> Scenario:
    """A scenario with these decisions; its worlds are not used."""
    N = lines.given["speeds_mps"].shape[1]
    roles = {f"vehicle_{i + 1}": "learner" if i in lines.learners else "full_brake" for i in range(N)}
    obstacle = {"obstacle_gap_m": 50} if "obstacle_gap_m" in lines.given else {}
    fields: dict[str, Any] = {
        "name": "lines", "title": "Lines", "description": "Lines.", "source": "a test", "vehicles": N, "roles": roles,
        "gaps_m": 50, "speeds_mps": 10, "braking_capacity_mps2": 6, "driving_capacity_mps2": 3, "mass_t": 2,
        "latency_s": [0] + [0.2] * (N - 1), "time_step_s": STEP_S, "horizon_s": HORIZON_S, "restitution": 0.1,
        "speed_limit_mps": 40, "brake_rate_mps3": 50, "early_impacts": "keep",
    } | obstacle  # fmt: skip
    return load_scenario(fields)


def commands_of(lines: Lines, step: int) -> Floats:
    """What every vehicle wants in the interval that ends with this decision, [n, N] m/s2: scripts brake fully."""
    vehicles = lines.worlds.vehicles
    command = -vehicles.braking_capacity_mps2
    for c, i in enumerate(lines.learners):
        command[:, i] = action_to_command(lines.actions[:, step - 1, c], vehicles, i) if step else 0.0
    return command


def by_engine(lines: Lines) -> Floats:
    """Speeds, gaps, forces and harm by pair after the engine's steps, [n, F]."""
    n, N = lines.given["speeds_mps"].shape
    others: dict[int, Any] = {i: make_agent("full_brake") for i in range(N) if i not in lines.learners}
    for i, each in lines.pieces.items():
        others[i] = StateFree("profile:" + ",".join(f"{time:g}={braking:.12g}" for time, braking in each))
    engine = Engine(scenario_of(lines), n, learners=lines.learners, scripts=others, worlds=lines.worlds)
    for step in range(lines.actions.shape[1]):
        engine.step(lines.actions[:, step])
    return columns(engine.worlds, engine.ledger)


def by_advance(lines: Lines) -> Floats:
    """The same after ``advance`` from decision to decision."""
    return columns(*advanced(lines))


def advanced(lines: Lines) -> tuple[Worlds, Ledger]:
    """The lines after ``advance`` from decision to decision, up to where everything stands and would stay so."""
    worlds, ended = lines.worlds, np.zeros(len(lines.actions), np.bool_)
    ledger = empty_ledger(worlds)
    for step, until in enumerate(lines.times_s):
        command = commands_of(lines, step)
        worlds, impacts = advance(worlds, command, until_s=np.where(ended, worlds.time_s, until))
        ledger = ledger.add(impacts)
        if step:
            wanted = worlds.vehicles.piece_commands(command, worlds.time_s)
            stays = (worlds.speeds_mps == 0.0) & (np.maximum(wanted, worlds.command_mps2) <= 0.0)
            ended |= stays.all(axis=1)
    return worlds, ledger


def columns(worlds: Worlds, ledger: Ledger) -> Floats:
    """State and harm of each line. Forces of a line at rest are left out: the engine ends the episode there."""
    force = np.where((worlds.speeds_mps == 0.0).all(axis=1, keepdims=True), 0.0, worlds.command_mps2)
    harm = [ledger.first_impact_harm, ledger.total_harm]
    if worlds.obstacle_ahead.any():
        harm += [ledger.obstacle_first_harm[:, np.newaxis], ledger.obstacle_total_harm[:, np.newaxis]]
    return np.concatenate([worlds.speeds_mps, worlds.gaps_m, force, *harm], axis=1)


def of_line(found: Floats, lines: Lines) -> Floats:
    """First-impact and total harm of the line, [n, 2], of what ``columns`` gave."""
    N = lines.given["speeds_mps"].shape[1]
    first, total, ahead = found[:, 3 * N - 1 : 4 * N - 2], found[:, 4 * N - 2 : 5 * N - 3], found[:, 5 * N - 3 :]
    counts = [np.zeros(len(found)), np.zeros(len(found))]
    for c, each in enumerate((first, total)):
        columns = [ahead[:, [c]], each] if ahead.shape[1] else [each]
        for column in np.concatenate(columns, axis=1).T:
            counts[c] += column
    return np.stack(counts, axis=1)


def by_search(lines: Lines) -> Floats:
    """Harm of the line under both counts, [n, 2], as the search foresees it."""
    problem = problem_of(lines, "first")
    n, T, _ = lines.actions.shape
    vehicles = lines.worlds.vehicles
    wanted = [action_to_command(lines.actions[:, :, c].ravel(), vehicles.take(np.repeat(np.arange(n), T)), i)
              for c, i in enumerate(lines.learners)]  # fmt: skip
    ends = np.broadcast_to(np.arange(1, T + 1), (n, T))
    return np.stack(problem.follow(Profiles(ends, np.stack(wanted, axis=1).reshape(n, T, -1))), axis=1)


def by_shield(lines: Lines) -> Floats:
    """The same, as the shield foresees it."""
    actions = lines.actions[:, :, 0] if len(lines.learners) == 1 else lines.actions
    counts: tuple[HarmCount, HarmCount] = ("first", "total")
    return np.stack([plan_harm(begin_running(problem_of(lines, each)), actions) for each in counts], axis=1)


def problem_of(lines: Lines, harm_count: HarmCount) -> ProfileProblem:
    problem = profile_problem(
        lines.worlds, lines.learners, harm_count=harm_count, horizon_s=HORIZON_S, time_step_s=STEP_S
    )
    problem.clock[:, CLOCK.STEPWISE] = 1.0
    return problem


def disagreeing(lines: Lines) -> Ints:
    """The lines that not all four move alike, to the bit."""
    engine, other = by_engine(lines), by_advance(lines)
    same = (engine == other).all(axis=1)
    for harm in (by_search(lines), by_shield(lines)):
        same &= (harm == of_line(engine, lines)).all(axis=1)
    return np.flatnonzero(~same)


def first_harm_error(lines: Lines, rows: Ints, step_s: float) -> Floats:
    """How far the first-impact harm of some lines is from that by small steps, in parts of 1 + harm."""
    exact = of_line(by_advance(lines), lines)[rows, 0]
    some = {key: value[rows] for key, value in lines.given.items()}
    commands = [commands_of(lines, step)[rows] for step in range(lines.actions.shape[1] + 1)]
    switches = [0.0, *lines.times_s]
    first = by_small_steps(some, commands, step_s, lines.pieces, switches)[4].sum(axis=1)
    return np.abs(first - exact) / (1.0 + exact)


KINDS = [
    (2, (1,), False, False),
    (3, (1,), False, False),
    (3, (1,), True, False),
    (3, (1,), False, True),
    (3, (1, 2), False, False),
    (3, (1, 2), True, False),
    (4, (1, 2), False, True),
    (5, (1, 2, 4), False, False),
    (4, (0, 1, 3), True, False),
    (5, (2, 3), True, True),
]


@pytest.mark.parametrize(("N", "learners", "obstacle", "in_pieces"), KINDS)
def test_engine_advance_search_and_shield__move_a_line_to_the_same_bits(
    N: int, learners: tuple[int, ...], obstacle: bool, in_pieces: bool
) -> None:
    lines = random_lines(1, 60, N, learners, obstacle=obstacle, in_pieces=in_pieces)
    assert disagreeing(lines).tolist() == []
    assert (of_line(by_advance(lines), lines)[:, 0] > 1.0).sum() > 20


@pytest.mark.parametrize(("N", "learners", "obstacle", "in_pieces"), KINDS[1::3])
def test_line__moves_as_by_small_steps(N: int, learners: tuple[int, ...], obstacle: bool, in_pieces: bool) -> None:
    lines = random_lines(2, 15, N, learners, obstacle=obstacle, in_pieces=in_pieces)
    assert (first_harm_error(lines, np.arange(15), 1e-4) < 5e-3).sum() >= 13  # a cascade may fall otherwise
