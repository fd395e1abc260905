"""What proofs and searches of the least harm refuse."""

import io
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.shipped import TABLES
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, Profiles, profile_problem
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.task import Task
from tests.fixtures.lines import line, wide_worlds
from tests.programmes.hostile import good_table
from tests.refused import refused

PAPER = load_scenario("paper-random")
WORLDS = PAPER.sample(1, 11).worlds
THREE = line([7, 7], [20, 18, 20], [6, 7, 6], [0, 0.5, 0.8])


@cache
def problem() -> ProfileProblem:
    return profile_problem(WORLDS, [1])


PROOFS: dict[str, Callable[[], object]] = {
    "avoidability: vehicle_1 of 3 vehicles is controlled, but the proofs cover only vehicle_2": lambda: avoidability(
        wide_worlds(2, 3, seed=1), 0
    ),
    "avoidability: vehicle = -1: must be a whole number in 0..2": lambda: avoidability(wide_worlds(2, 3, seed=1), -1),
    "avoidability: vehicle_3 follows the script 'coast'; must be 'full_brake'": lambda: avoidability(
        wide_worlds(2, 3, seed=1), scripts={2: "coast"}
    ),
    "avoidability: latency_s[0, 0] = 1: must be at most the latency of vehicle_2": lambda: avoidability(
        line([5, 5], [9, 9, 9], 5, [1, 0.5, 0])
    ),
    "avoidability: speeds_mps[0, 1] = nan: must be >= 0": lambda: avoidability(
        replace(line([5], [9, 9], 5), speeds_mps=np.array([[9, np.nan]])), 1
    ),
    "harm_count = 'worst': must be 'first' or 'total'": lambda: lower_bound(THREE, harm_count="worst"),
    "lower_bound: horizon_s = 0.2: the horizon must be finite and at least 0.5 s": lambda: lower_bound(
        THREE, horizon_s=0.2
    ),
    "lower_bound: horizon_s = inf: the horizon must be finite and at least 0.5": lambda: lower_bound(
        THREE, horizon_s=float("inf")
    ),
    "lower_bound: horizon_s = '8': the horizon must be a number (time in s)": lambda: lower_bound(THREE, horizon_s="8"),
    "lower_bound: time_step_s = 0.0: must be a finite number of at least 0.001": lambda: lower_bound(
        THREE, time_step_s=0.0
    ),
    "lower_bound: time_step_s = True: must be a finite number of at least 0.001": lambda: lower_bound(
        THREE, time_step_s=True
    ),
    "lower_bound: time_step_s = nan: must be a finite number of at least 0.001": lambda: lower_bound(
        THREE, time_step_s=float("nan")
    ),
    "lower_bound: world 0 has an obstacle ahead; the bound is proven without an obstacle": lambda: lower_bound(
        load_scenario("paper-random-obstacle").sample(1, 7).worlds
    ),
    "avoidability: the result would not be exact, because brakes in world 0 build up at a finite rate;": lambda: (
        avoidability(PAPER.replace(brake_rate_mps3=9).sample(2, 7).worlds)
    ),
    "avoidability: a vehicle of world 0 follows a braking profile, for which the result would not be exact;": lambda: (
        avoidability(PAPER.replace(roles={"vehicle_1": "profile:0=3,1=5", "vehicle_2": "learner"}).sample(2, 7).worlds)
    ),
}


@pytest.mark.parametrize("message", PROOFS)
def test_proof__is_refused_where_nothing_exact_is_known(message: str) -> None:
    with refused(message):
        PROOFS[message]()


SEARCHES: dict[str, Callable[[], object]] = {
    "horizon_s = 0.4: must be after the first decision at 0.5 s": lambda: profile_problem(WORLDS, [1], horizon_s=0.4),
    "task: vehicles (3,): must be different indices from 0 to 2": lambda: Task(PAPER, (3,)),
    "task: vehicles (0, 0): must be different indices from 0 to 2": lambda: Task(PAPER, (0, 0)),
    "scenario 'paper-random': this function needs exactly one controlled vehicle; the controlled vehicles": lambda: (
        Task(PAPER, (0, 1)).vehicle
    ),
    "vehicles = (): must be one or more vehicle indices from 0 to 2": lambda: best_harm(PAPER, WORLDS, vehicles=()),
    "budget = 0: must be a whole number, at least 1": lambda: best_harm(PAPER, WORLDS, budget=0),
    "threads = 0: must be a whole number, at least 1": lambda: best_harm(PAPER, WORLDS, budget=10, threads=0),
    "counts = (): counts must contain 'first', 'total' or both": lambda: best_harm(PAPER, WORLDS, budget=10, counts=()),
    "profiles: command -7.1 m/s2 is beyond a vehicle's capacity": lambda: problem().follow(
        problem().constant(np.array([[[-7.1]]]))
    ),
    "profiles: ends (the steps at which phases end) must not decrease within a profile, and the": lambda: (
        problem().follow(Profiles(np.array([[9, 5, 75]]), np.zeros((1, 3, 1))))
    ),
    "t.npz: there is no such file": lambda: BestHarmTable.load(Path("t.npz")),
    "the braking profiles in these worlds differ from the braking profiles in": lambda: best_harm(
        PAPER.replace(roles={"vehicle_1": "profile:0=3,1=5", "vehicle_2": "learner"}), PAPER.sample(2, 7).worlds
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", SEARCHES)
def test_search__is_refused(message: str) -> None:
    with refused(message):
        SEARCHES[message]()


def test_file__is_no_table(empty_folder: Path) -> None:
    Path("t.npz").write_bytes(b"no table")
    with refused("t.npz: is not a table of best known harm: not a plain .npz archive", CorruptBundle):
        BestHarmTable.load(Path("t.npz"))
    with np.load(io.BytesIO(good_table())) as arrays:
        np.savez_compressed("t.npz", **{**arrays, "first_harm": np.zeros(4)})
    with refused("array 'first_harm' has type <f8 and shape [4]; must have type <f8 and shape [3]", CorruptBundle):
        BestHarmTable.load(Path("t.npz"))


def test_table__of_other_worlds_is_refused() -> None:
    table = BestHarmTable.load(TABLES / "paper-delay-low.npz")
    with refused("table of best known harm (scenario paper-delay-low, list_seed 7, episodes 2000"):
        table.check_holds_any(problem().identity)
