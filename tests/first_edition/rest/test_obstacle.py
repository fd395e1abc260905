"""An obstacle ahead of Vehicle 1, from the scenario to the results: every module counts it, and counts it alike."""

from collections.abc import Callable

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.game.harm import empty_ledger
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from tests.refused import refused

ALL = load_scenario("cooperation-4-all")
NEAR = ALL.replace(obstacle_gap_m={"uniform": [10, 45]})  # within the way of full braking in many worlds


def test_profiles__are_followed_with_the_obstacle_as_the_engine_drives_them() -> None:
    worlds = NEAR.sample(30, 7).worlds
    problem = profile_problem(worlds, [0, 1, 2], horizon_s=NEAR.horizon_s)
    commands = np.broadcast_to(np.array([-3.0, -2.5, -6.0]), (30, 1, 3))
    found = problem.follow(problem.constant(commands))
    scripts = {i: make_agent(spec) for i, spec in enumerate(("constant:3", "constant:2.5", "full_brake"))}
    engine = eb.Engine(NEAR, 30, learners=(), scripts=scripts, deciders=(0, 1, 2), worlds=worlds)
    while not engine.ended.all():
        engine.step({})
    np.testing.assert_array_equal(found, [engine.ledger.world_harm("first"), engine.ledger.world_harm("total")])
    assert (engine.ledger.obstacle_count > 0).sum() > 10
    moved = profile_problem(NEAR.replace(obstacle_gap_m=44).sample(30, 7).worlds, [0, 1, 2], horizon_s=NEAR.horizon_s)
    assert (problem.identity != moved.identity).all()


def test_coupled__vehicle_1_stops_short_of_the_obstacle_if_it_can() -> None:
    worlds = ALL.sample(6, 7).worlds
    found = optimise_coupled(worlds, 0, harm_count="total")
    command = -worlds.vehicles.braking_capacity_mps2
    harms = []
    for a in (*np.linspace(0.0, 6.0, 25), found.deceleration_mps2):
        command[:, 0] = -a
        harms.append(empty_ledger(worlds).add(eb.advance(worlds, command, until_s=8.0)[1]).world_harm("total"))
    assert harms[-1].tolist() == found.harm.tolist() and (found.harm <= np.min(harms, axis=0)).all()


@pytest.mark.parametrize("vehicle", [0, 1])
def test_shield__step_mode_bounds_the_harm_of_the_obstacle_too_to_the_last_bit(vehicle: int) -> None:
    scenario = NEAR.with_learners([vehicle])
    agent = ShieldedDriver(make_agent("coast"), scenario, harm_count="total")
    episodes = drive(scenario.sample(40, 7).worlds, agent, scenario, vehicle)
    harm, shield = episodes.ledger.world_harm("total"), episodes.guarded.shield
    assert not shield.memory.distrusted.any()
    assert (harm <= shield.predicted_harm).all() and np.array_equal(harm, shield.bound)
    assert (shield.interventions > 0).sum() > 5 and (episodes.ledger.obstacle_count > 0).any()


STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
REFUSED: dict[str, Callable[[], object]] = {
    "scenario 'cooperation-4-all': obstacle_gap_m = 0: must be finite and in (0": lambda: ALL.replace(obstacle_gap_m=0),
    "vehicle_1 can learn only with an obstacle ahead; add one, for instance obstacle_gap_m: 42": lambda: load_scenario(
        "cooperation-3-pair"
    ).with_learners([0, 1]),
    "initial_state: obstacle_gap_m is missing; scenario 'cooperation-4-all' has no": lambda: worlds_from_state(
        NEAR, STATE
    ),
    "initial_state: obstacle_gap_m cannot be set, because scenario 'paper-random' does not declare it": lambda: (
        worlds_from_state(load_scenario("paper-random"), {**STATE, "obstacle_gap_m": 30})
    ),
    "initial_state: obstacle_gap_m = 0: must be finite and in (0, 10000] m (metres)": lambda: worlds_from_state(
        ALL, {**STATE, "obstacle_gap_m": 0}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_obstacle__that_is_missing_or_nowhere_is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()
