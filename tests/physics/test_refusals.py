"""What worlds, commands and times the physics refuses."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.game.harm import empty_ledger
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.forecast import forecast
from ethbrake_marl.physics.paper_map import advance_sampled
from tests.physics.random_worlds import line
from tests.refused import refused

PAIR = line([5.0], [1.0, 1.0], braking_capacity_mps2=10.0, driving_capacity_mps2=10.0)
THREE = line([5.0, 6.0], [10.0, 11.0, 12.0], braking_capacity_mps2=[7.0, 7.0, 6.0], latency_s=[0.0, 0.5, 0.8])
FOUR = THREE.take(np.zeros(4, int))
# Vehicle 1 leaves vehicle 2 with 1e-9 m/s; vehicle 3 meets them after 1 s: no advance leaves such an overlap.
OVERLAPPING = replace(line([0.0, 8.0], [1e-9, 0.0, 8.0]), gaps_m=np.array([[-2.000001e-9, 8.0]]))


WORLDS: dict[str, Callable[[], object]] = {
    "gaps_m[0, 1] = -0.5: must be finite and in [0, inf]": lambda: line([5.0, -0.5], [9.0, 9.0, 9.0]),
    "gaps_m[0, 1] = inf: must be finite and in [0, inf]": lambda: line([5.0, inf], [9.0, 9.0, 9.0]),
    "gaps_m[0, 1] = -1: must be finite and in [0, inf]": lambda: line([5.0, 6.0], [9.0, 9.0, 9.0]).running(
        1.0, [1.0, -1.0], 3.0
    ),
    "speeds_mps[0, 1] = nan: must be finite and in [0, inf]": lambda: line([5.0, 6.0], [10.0, nan, 1.0]),
    "speeds_mps[1, 2] = 65: must be at most this vehicle's speed_limit_mps 64": lambda: line(
        [5.0, 6.0], [[1.0, 2.0, 3.0], [1.0, 2.0, 65.0]]
    ),
    "restitution[0] = 1.5: must be finite and in [0, 1]": lambda: line([5.0], [9.0, 9.0], restitution=1.5),
    "obstacle_gap_m[0] = -0.5: must be finite and in [0, inf]": lambda: line([5.0], [9.0, 9.0], obstacle_gap_m=-0.5),
    "obstacle_gap_m[0] = inf: must be finite and in [0, inf]": lambda: line([5.0], [9.0, 9.0], obstacle_gap_m=inf),
    "mass_t: has shape (2,); must have shape (1, 3)": lambda: line([5.0, 6.0], [9.0, 9.0, 9.0], mass_t=[1.0, 2.0]),
    "speeds_mps: has shape (1, 1); must have shape [n, N] with N >= 2 vehicles": lambda: line([5.0, 6.0], [10.0]),
    "speeds_mps: has shape (2, 3); must have shape (3, 3)": lambda: line(np.ones((3, 2)), np.zeros((2, 3))),
    "brake_rate_mps3[0, 1] = 0: must be in (0, inf]": lambda: line([5.0], [9.0, 9.0], brake_rate_mps3=[9.0, 0.0]),
    "release_rate_mps3[0, 0] = nan: must be in (0, inf]": lambda: line([5.0], [9.0, 9.0], release_rate_mps3=nan),
}


@pytest.mark.parametrize("message", WORLDS)
def test_world__is_refused(message: str) -> None:
    with refused(message):
        WORLDS[message]()


ADVANCES: dict[str, Callable[[], object]] = {
    "command_mps2[0, 0] = -11: must be in [-10, 10] m/s2": lambda: advance(PAIR, [-11.0, 0.0], 1.0),
    "command_mps2[1, 1] = -17: must be in [-16, 16] m/s2": lambda: advance(
        line([5.0], [[9.0, 9.0], [9.0, 9.0]], obstacle_gap_m=9.0), [[0.0, 0.0], [0.0, -17.0]], 1.0, threads=2
    ),
    "command_mps2[0, 0] = nan: must be in [-10, 10] m/s2": lambda: advance(PAIR, [nan, 0.0], 1.0),
    "command_mps2: has shape (3,); must have shape (1, 2)": lambda: advance(PAIR, [0.0, 0.0, 0.0], 1.0),
    "advance: world 0 is at t = 0 s, but the requested end time is -1 s": lambda: advance(PAIR, 0.0, -1.0),
    "advance: world 1 is at t = 0 s, but the requested end time is -1 s": lambda: advance(
        FOUR, 0.0, until_s=[1.0, -1.0, 1.0, 1.0]
    ),
    "advance: world 0 is at t = 0 s, but the requested end time is inf s": lambda: advance(PAIR, 0.0, until_s=inf),
    "advance: pass either duration_s or until_s": lambda: advance(PAIR, 0.0),
    "threads = 0: must be a whole number, at least 1": lambda: advance(PAIR, 0.0, 1.0, threads=0),
    "threads = True: must be a whole number, at least 1": lambda: advance(PAIR, 0.0, 1.0, threads=True),
    "command_mps2 has the shape (1, 2) and candidates_mps2 (1, 1); the shapes must be (1, 3) and (1, K)": lambda: (
        forecast(THREE, np.zeros((1, 2)), 1, np.zeros((1, 1)), 8.0)
    ),
    "forecast: vehicle = 3: must be an index": lambda: forecast(THREE, np.zeros((1, 3)), 3, np.zeros((1, 1)), 8.0),
    "forecast: the candidate command -7.5 m/s2 is beyond the capacity of vehicle_2": lambda: forecast(
        THREE, np.zeros((1, 3)), 1, np.full((1, 1), -7.5), 8.0
    ),
    "forecast: the candidate command nan m/s2 is beyond the capacity of vehicle_2": lambda: forecast(
        THREE, np.zeros((1, 3)), 1, np.full((1, 1), nan), 8.0
    ),
}


@pytest.mark.parametrize("message", ADVANCES)
def test_advance_and_forecast__are_refused(message: str) -> None:
    with refused(message):
        ADVANCES[message]()


SAMPLED: dict[str, Callable[[], object]] = {
    "command_mps2[0, 2] = -9: must be in [-6, 16] m/s2": lambda: advance_sampled(FOUR, [0.0, 0.0, -9.0], until_s=1.0),
    "command_mps2: has shape (2,); must have shape (4, 3)": lambda: advance_sampled(FOUR, [0.0, 0.0], until_s=1.0),
    "advance_sampled: world 0 cannot be advanced from 0 s to -1 s; the end must not be earlier than the": lambda: (
        advance_sampled(FOUR, 0.0, until_s=-1.0)
    ),
    "advance_sampled: world 2 cannot be advanced from 0 s to nan s; the end must not be earlier": lambda: (
        advance_sampled(FOUR, 0.0, until_s=[1.0, 1.0, nan, 1.0])
    ),
    "than the start, and at most 1,000,000,000 steps of 1.90735e-06 s later": lambda: advance_sampled(
        PAIR, 0.0, until_s=np.nextafter(1e9 * 2.0**-19, inf), step_s=2.0**-19
    ),
    "step_s = 0: must be finite and at least 1e-06 s": lambda: advance_sampled(FOUR, 0.0, until_s=1.0, step_s=0.0),
    "step_s = nan: must be finite and at least 1e-06 s": lambda: advance_sampled(FOUR, 0.0, until_s=1.0, step_s=nan),
    "advance_sampled: world 0 is at 0.53 s, between two of its sampling times, which are 0.5 s + n * 0.1 s": lambda: (
        advance_sampled(advance(FOUR, 0.0, until_s=0.53)[0], 0.0, until_s=1.0)
    ),
    "world 0 is at 1 s, between two of its sampling times, which are 0 s + n": lambda: advance_sampled(
        replace(PAIR, time_s=np.array([1.0 + 1.5e-6])), 0.0, until_s=2.0, step_s=1.0
    ),
    "world 0 is at 0.999999 s, between two of its sampling times, which are 0 s + n": lambda: advance_sampled(
        replace(PAIR, time_s=np.array([1.0 - 1.5e-6])), 0.0, until_s=2.0, step_s=1.0
    ),
    "advance_sampled: world 0 has an obstacle ahead (obstacle_gap_m = 10)": lambda: advance_sampled(
        line([5.0], [9.0, 9.0], obstacle_gap_m=10.0), -6.0, until_s=1.0
    ),
    "advance_sampled: the result would not be exact, because brakes in world 0 build up": lambda: advance_sampled(
        line([5.0], [9.0, 9.0], brake_rate_mps3=9.0), [[0.0, 0.0]], until_s=1.0
    ),
    "advance_sampled: a vehicle of world 0 follows a braking profile, for which the result would not be": lambda: (
        advance_sampled(line([5.0], [9.0, 9.0]).play_pieces({1: [(0, 3), (1, 5)]}), [[0.0, 0.0]], until_s=1.0)
    ),
}


@pytest.mark.parametrize("message", SAMPLED)
def test_sampled_map__is_refused(message: str) -> None:
    with refused(message):
        SAMPLED[message]()


def test_sampled_map__knows_no_impact_before_its_first_sample() -> None:
    thrown, _ = advance(line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5, latency_s=[0.0, 0.5]), 0.0, 0.1)
    with refused("advance_sampled: world 0 has a negative speed at 0.1 s, before its first sample at 0.5 s"):
        advance_sampled(thrown, 0.0, until_s=1.0)


def test_contact_that_was_missed__is_a_defect_with_the_world_and_the_time() -> None:
    with refused("world 0: a contact was missed between 0 s and 1 s", PhysicsError):
        advance(OVERLAPPING, 0.0, 1.0)
    with refused("world 0: the forecast to 2 s failed", PhysicsError):
        forecast(OVERLAPPING, np.zeros((1, 3)), 1, np.zeros((1, 1)), 2.0)


@pytest.mark.parametrize("harm", ["obstacle_harm", "pair_harm", "vehicle_harm", "world_harm"])
def test_harm__counts_first_or_total(harm: str) -> None:
    with refused("harm_count = 'both': must be 'first' or 'total'"):
        getattr(empty_ledger(PAIR), harm)("both")
