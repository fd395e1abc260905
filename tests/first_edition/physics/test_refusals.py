"""What worlds, commands and times the physics refuses."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.first_edition.game.harm import empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.paper_map import advance_sampled
from tests.first_edition.physics.random_worlds import line
from tests.refused import refused

PAIR = line([5.0], [1.0, 1.0], braking_capacity_mps2=10.0, driving_capacity_mps2=10.0)
THREE = line([5.0, 6.0], [10.0, 11.0, 12.0], braking_capacity_mps2=[7.0, 7.0, 6.0], latency_s=[0.0, 0.5, 0.8])
FOUR = THREE.take(np.zeros(4, int))
# Vehicle 1 leaves vehicle 2 with 1e-9 m/s; vehicle 3 meets them after 1 s: no advance leaves such an overlap.
OVERLAPPING = replace(line([0.0, 8.0], [1e-9, 0.0, 8.0]), gaps_m=np.array([[-2.000001e-9, 8.0]]))


WORLDS: dict[str, Callable[[], object]] = {
    "gaps_m[0, 1] = -0.5: must be finite and": lambda: line([5.0, -0.5], [9.0, 9.0, 9.0]),
    "speeds_mps[1, 2] = 65: must be at most": lambda: line([5.0, 6.0], [[1.0, 2.0, 3.0], [1.0, 2.0, 65.0]]),
    "mass_t: has shape (2,); must have shape": lambda: line([5.0, 6.0], [9.0, 9.0, 9.0], mass_t=[1.0, 2.0]),
    "speeds_mps: has shape (1, 1); must have": lambda: line([5.0, 6.0], [10.0]),
}


@pytest.mark.parametrize("message", WORLDS)
def test_world__is_refused(message: str) -> None:
    with refused(message):
        WORLDS[message]()


ADVANCES: dict[str, Callable[[], object]] = {
    "command_mps2[0, 0] = -11: must be in": lambda: advance(PAIR, [-11.0, 0.0], 1.0),
    "command_mps2: has shape (3,); must have": lambda: advance(PAIR, [0.0, 0.0, 0.0], 1.0),
    "advance: world 0 is at t = 0 s, but the": lambda: advance(PAIR, 0.0, -1.0),
    "advance: pass either duration_s or": lambda: advance(PAIR, 0.0),
    "command_mps2 has the shape (1, 2) and": lambda: forecast(THREE, np.zeros((1, 2)), 1, np.zeros((1, 1)), 8.0),
    "forecast: vehicle = 3: must be an index": lambda: forecast(THREE, np.zeros((1, 3)), 3, np.zeros((1, 1)), 8.0),
}


@pytest.mark.parametrize("message", ADVANCES)
def test_advance_and_forecast__are_refused(message: str) -> None:
    with refused(message):
        ADVANCES[message]()


SAMPLED: dict[str, Callable[[], object]] = {
    "advance_sampled: world 0 cannot be": lambda: advance_sampled(FOUR, 0.0, until_s=-1.0),
    "step_s = 0: must be finite and at least": lambda: advance_sampled(FOUR, 0.0, until_s=1.0, step_s=0.0),
    "advance_sampled: world 0 has an": lambda: advance_sampled(
        line([5.0], [9.0, 9.0], obstacle_gap_m=10.0), -6.0, until_s=1.0
    ),
    "advance_sampled: the result would not": lambda: advance_sampled(
        line([5.0], [9.0, 9.0], brake_rate_mps3=9.0), [[0.0, 0.0]], until_s=1.0
    ),
    "advance_sampled: a vehicle of world 0": lambda: advance_sampled(
        line([5.0], [9.0, 9.0]).play_pieces({1: [(0, 3), (1, 5)]}), [[0.0, 0.0]], until_s=1.0
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
