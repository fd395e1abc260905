"""A neighbour that is known, but cannot be predicted: there is no forecast, and agents brake fully."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.observe import View
from tests.episode.lines import later, state_of

pytest.importorskip("ethbrake_marl.extensions.messages")

PIECES = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass"]
FORECASTS = ["plan", "forecast", "contact"]


def without(scenario: Any, piece: str, senders: list[int], **v2x: Any) -> eb.Scenario:
    """Scenario in which the messages of ``senders`` lack a piece."""
    tells = {f"vehicle_{sender}": [name for name in PIECES if name != piece] for sender in senders}
    channel = {"preset": "nominal", "persistence": "periodic", "tells": tells, **v2x}
    return eb.load_scenario(scenario).replace(v2x=channel)


@pytest.mark.parametrize("piece", ["mass", "latency", "braking_capacity"])
@pytest.mark.parametrize("senders", [[1], [3], [1, 3]])
@pytest.mark.parametrize("scenario", ["paper-random", "cooperation-2-five"])
def test_neighbour_without_a_piece__is_met_with_full_braking(scenario: str, senders: list[int], piece: str) -> None:
    result = eb.evaluate(without(scenario, piece, senders), "full_brake,plan", episodes=20, harm_count="honest")
    full, plan = result["full_brake"]["honest_cost"], result["plan"]["honest_cost"]
    assert (plan == full).mean() > 0.9  # before it hears of one neighbour at all, it may plan for the other
    np.testing.assert_allclose(plan, full, atol=0.5)


def test_farther_vehicle_without_a_piece__ends_the_forecast_before_it() -> None:
    result = eb.evaluate(without("cooperation-2-five", "mass", [5]), "full_brake,plan", episodes=50)
    assert result["plan"]["honest_cost"].mean() < 0.8 * result["full_brake"]["honest_cost"].mean()


def observed(scenario: eb.Scenario, until_s: float) -> dict[str, np.ndarray]:
    _, game = eb.open_game(scenario, observation=["front_1.known", *FORECASTS])
    state = game.reset(scenario.sample(20, 7))
    while state.time_s[0] < until_s - 1e-9:
        state, _ = game.step(state, np.full((20, 1), -1.0))
    return dict(zip(game.views[2].names, game.observe(state, np.array([2]))[0].T, strict=True))


def test_forecast__waits_until_the_neighbour_can_be_predicted() -> None:
    sight = {"link_latency_s": 0.0, "senses": "front", "sensing_s": [0.9, 0.9]}
    scenario = without("paper-random", "acceleration", [1], **sight)
    before, after = observed(scenario, 0.7), observed(scenario, 1.0)
    assert (before["front_1.known"] == 1.0).all() and (before["forecast.known"] == 0.0).all()
    assert (before["plan.action"] == -1.0).all() and (after["forecast.known"] == 1.0).all()
    times = [name for name in before if name.endswith("_time") and "own_" not in name]
    assert len(times) == 6 and not any(before[name].any() for name in times)
    assert all(after[name].all() for name in ("contact.brake_front_time", "contact.brake_rear_time"))
    assert (after["plan.action"] > -1.0).any()


def test_far_neighbour_without_a_piece__does_not_matter() -> None:
    four = eb.load_scenario("paper-random").replace(
        vehicles=4, gaps_m=[200, 7, 8], braking_capacity_mps2=[6, 7, 6, 6], driving_capacity_mps2=6, mass_t=5,
        latency_s=[0, 0.5, 0.8, 0.8], early_impacts="keep",
    )  # fmt: skip
    told = four.replace(v2x={"preset": "nominal", "persistence": "periodic"})
    results = [eb.evaluate(line, "full_brake,plan", episodes=20) for line in (told, without(four, "mass", [1]))]
    costs = [result["plan"]["honest_cost"] for result in results]
    np.testing.assert_array_equal(*costs)
    assert costs[0].mean() < 0.8 * results[0]["full_brake"]["honest_cost"].mean()


def test_who_knows_nobody__brakes_fully() -> None:
    scenario = eb.load_scenario("paper-random").replace(v2x="blocked", horizon_s=20, early_impacts="keep")
    state = later(scenario.sample(300, 1), 0.0, 0.6)
    nobody = (state.know[:, 2, [1, 3]] > 0.6).all(axis=1)
    action = View(["plan.action"]).observe(state, np.array([2]), 0.1)[:, 0, 0]
    assert 10 < nobody.sum() < 290 and (action[nobody] == -1.0).all() and (action[~nobody] > -1.0).any()


def test_plan__does_not_depend_on_vehicles_of_which_its_own_knows_nothing() -> None:
    scenario = eb.load_scenario("cooperation-3-five")
    scenario = scenario.replace(v2x={"preset": "nominal", "hears": "front", "senses": "front"})
    _, game = eb.open_game(scenario)
    agent, rng = replace(eb.make_agent("plan", scenario=scenario), candidates=60), np.random.default_rng(3)
    state, compared = game.reset(scenario.sample(12, 11)), 0
    for _ in range(6):
        for body in (3, 4):
            unknown = state.know[:, [body]] > state.time_s[:, np.newaxis, np.newaxis]
            unknown[:, :, body] = False
            other = state._replace(car=np.where(unknown, rng.uniform(1.0, 9.0, state.car.shape), state.car))
            answers = [agent.act(worlds, agent.begin(worlds, body), body) for worlds in (state, other)]
            np.testing.assert_array_equal(*(command for command, _ in answers))
            np.testing.assert_array_equal(*(memory.plan for _, memory in answers))
            compared += unknown.any(axis=(1, 2)).sum()
        state, _ = game.step(state, rng.uniform(-1.0, 0.0, (12, len(game.settings.learners))))
    assert compared > 100


def test_vehicle_1__plans_alone_for_an_obstacle() -> None:
    state = state_of([30.0], [20.0, 20.0], obstacle_gap_m=60.0, braking_capacity_mps2=5.0)
    know = state.know.copy()
    know[:, 1, 2] = np.inf
    action = View(["plan.action"]).observe(state._replace(know=know), np.array([1]), 0.1)[0, 0, 0]
    assert -1.0 < action < -0.6  # 400 / 120 m/s2 are enough
