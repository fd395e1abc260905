"""Episodes of any agents: recorded by actions that replay them."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation.episodes import Recording, Task, record_episodes
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.physics import Worlds
from ethbrake_marl.rewards import reward_params
from ethbrake_marl.scenario import Scenario
from tests.contract.interfaces import FIVE, PAPER

PAIR = eb.load_scenario("cooperation-3-pair")


def record(spec: str, scenario: Scenario = PAPER, n: int = 12) -> Recording:
    task = Task(scenario, 7, reward_params("harm"), eb.observation_for(scenario))
    ((name, driver),) = make_lineup([spec], scenario).items()
    return record_episodes(scenario.sample(n, 7), driver, name, task)


@pytest.mark.parametrize("spec", ["full_brake", "ppo@shipped"])
def test_record__an_agent_whose_commands_are_actions_is_as_in_an_evaluation(spec: str) -> None:
    found = record(spec)
    assert found.off_by == 0.0
    sample = PAPER.sample(12, 7)
    outcome = eb.evaluate(sample, make_lineup([spec], PAPER), scenario=PAPER).outcome(spec)
    assert np.array_equal(found.ledger.world_harm("first"), outcome.first_impact_harm)
    assert np.array_equal(found.ledger.world_harm("total"), outcome.total_harm)


@pytest.mark.parametrize("spec", ["best_harm", "e_v2x_bm", "full_brake+step", "ppo@shipped+refined+episode"])
def test_record__of_any_agent_the_harm_is_that_of_its_float32_actions(spec: str) -> None:
    found = record(spec)
    assert found.actions.dtype == np.float32 and np.abs(found.actions).max() <= 1.0
    env = eb.EthBrakeVectorEnv(12, PAPER)
    env.reset(seed=7, options={"listed_world": {"seed": 7, "number": 0}})
    for t, actions in enumerate(found.actions):
        running = found.running[:, t]
        seen, reward, *_ = env.step(actions)
        assert np.array_equal(reward[running], found.steps[t].reward[running, 1])
        going_on = found.decisions > t + 1  # elsewhere a new episode begins
        assert np.array_equal(seen[going_on], found.observations[t + 1, going_on, 0])


def test_record__on_the_edge_of_an_impact_takes_the_rounding_that_keeps_the_harm() -> None:
    # Rounded to the nearest action, the optimum of one of these worlds loses an impact worth 2.3 m2/s2.
    assert record("e_v2x_bm", n=60).off_by < 1e-3


@pytest.mark.parametrize("scenario", [FIVE, PAIR, eb.load_scenario("paper-random-obstacle")], ids=lambda s: s.name)
def test_record__knows_where_every_vehicle_is(scenario: Scenario) -> None:
    found = record("full_brake", scenario)
    worlds: Worlds = scenario.sample(12, 7).worlds
    gaps = found.positions_m[:, :, :-1] - found.positions_m[:, :, 1:]
    outcome = eb.evaluate(worlds, {"a": eb.make_agent("full_brake")}, scenario=scenario).outcome("a")
    for k, end in enumerate(found.decisions):
        assert gaps[end, k] == pytest.approx(outcome.final.gaps_m[k], abs=1e-9)
        assert found.speeds_mps[end, k] == pytest.approx(outcome.final.speeds_mps[k], abs=1e-12)
        way = np.diff(found.positions_m[: end + 1, k], axis=0)
        most = np.maximum(found.speeds_mps[:end, k], found.speeds_mps[1 : end + 1, k]) * scenario.time_step_s
        undisturbed = np.diff(found.told("world_total_harm")[: end + 1, k, 0]) == 0.0
        assert (way[undisturbed] <= most[undisturbed] + 1e-9).all()


def test_record__the_first_place_is_a_stopping_distance() -> None:
    # Vehicle 1 brakes from the alert on by its full capacity b: v t - b t^2 / 2 until the first decision.
    found, worlds = record("full_brake"), PAPER.sample(12, 7).worlds
    start, speed, braking = 0.5, worlds.speeds_mps[:, 0], worlds.vehicles.braking_capacity_mps2[:, 0]
    assert found.positions_m[0, :, 0] == pytest.approx(speed * start - braking * start**2 / 2)
    assert (found.told("time_s")[0] == start).all()


def test_record__ends_each_episode_where_it_ended() -> None:
    found = record("full_brake")
    for k, end in enumerate(found.decisions):
        over = [bool(step.terminated[k] | step.truncated[k]) for step in found.steps[:end]]
        assert over == [False] * (end - 1) + [True]
