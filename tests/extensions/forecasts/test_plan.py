"""The plan against costs that a separate simulation finds, and what it assumes of the others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import note_motion
from ethbrake_marl.extensions.forecasts.contacts import FORECAST_S
from ethbrake_marl.motion import layout as at
from tests.episode.lines import later, state_of
from tests.motion.lines import driven
from tests.refused import refused

PLAN = View(["plan"])
PAPER = eb.load_scenario("paper-random")


def plan_of(state: State, body: int) -> dict[str, np.ndarray]:
    values = PLAN.observe(state, np.array([body]), 0.1)[:, 0]
    return {f.name.partition(".")[2]: values[:, c] * f.scale for c, f in enumerate(PLAN.features)}


def cost(state: State, body: int, action: Any, others: Any) -> np.ndarray:
    """Honest cost of the time of a forecast, if the vehicle holds ``action`` and the others their commands."""
    commands = np.array(others, float, copy=True)
    commands[:, body - 1] = action * state.car[:, at.BRAKING, body]
    before = np.zeros_like(state.line)
    rows = [at.SPEED, at.FORCE, at.GAP, at.HIT]
    before[:, rows] = state.line[:, rows]
    line, _, _ = driven(before, state.car, commands, state.time_s, state.time_s + FORECAST_S)
    for one in line:
        note_motion(one, np.zeros_like(state.car[0]))
    return state._replace(line=line).harm("honest")


@pytest.mark.parametrize("until_s", [0.8, 1.5])
def test_plan__is_the_best_of_nine_brakings_and_of_nine_around_it(until_s: float) -> None:
    commands = -PAPER.sample(60, 3).braking_capacity_mps2
    state = later(PAPER.sample(60, 3), commands, until_s)
    plan, trials = plan_of(state, 2), np.linspace(-1.0, 0.0, 9)
    coarse = np.array([cost(state, 2, action, commands) for action in trials])
    fine = [
        cost(state, 2, np.clip(trials[coarse.argmin(axis=0)] + part / 32.0, -1.0, 0.0), commands)
        for part in range(-4, 5)
    ]
    least = np.minimum(coarse.min(axis=0), np.min(fine, axis=0))
    np.testing.assert_allclose(cost(state, 2, plan["action"], commands), plan["best_speed"] ** 2, rtol=1e-4, atol=1e-3)
    assert (plan["best_speed"] ** 2 <= coarse.min(axis=0) * (1 + 1e-5) + 1e-3).all()
    single = (coarse < coarse.min(axis=0) + 1e-6).sum(axis=0) == 1  # elsewhere the middle one of several is the best
    assert single.sum() > 20
    np.testing.assert_allclose(plan["best_speed"][single] ** 2, least[single], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(plan["brake_speed"] ** 2, coarse[0], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(plan["coast_speed"] ** 2, np.minimum(coarse[-1], 3600.0), rtol=1e-4, atol=1e-3)


def test_plan__by_hand() -> None:
    # Vehicle 1 brakes at 4 m/s2 from 20 m/s and stops after 50 m. Vehicle 2, 30 m behind, stops without contact if it
    # brakes at 2.5 m/s2 or more, half of its capacity. Coasting it hits after 2 t^2 = 30 m with 4 t.
    usual = {"braking_capacity_mps2": [4.0, 5.0], "restitution": 0.0, "brake_rate_mps3": [np.inf, 10.0]}
    state = later(state_of([30.0], [20.0, 20.0], **usual), [-4.0, 0.0], 1e-9)
    plan = {name: float(value[0]) for name, value in plan_of(state, 2).items()}
    assert -0.9 < plan["action"] < -0.5 and plan["best_speed"] == plan["brake_speed"] == 0.0
    assert plan["best_front_time"] == plan["brake_front_time"] == 4.0  # none, cut
    assert plan["coast_front_time"] == pytest.approx(math.sqrt(15.0), abs=1e-4)
    assert plan["coast_front_closing_speed"] == pytest.approx(4.0 * math.sqrt(15.0), abs=1e-4)
    assert (plan["own_build_up_time"], plan["own_release_time"], plan["front_build_up_time"]) == (0.5, 0.0, 0.0)
    assert plan["coast_rear_time"] == plan["rear_build_up_time"] == 0.0  # nobody is behind


def test_who_is_not_known__is_not_planned_for() -> None:
    scenario = PAPER.replace(v2x="blocked", horizon_s=20, early_impacts="keep")
    state = later(scenario.sample(300, 1), 0.0, 0.6)
    unknown = state.know[:, 2, 3] > 0.6
    assert unknown.any() and not unknown.all()
    line = state.line.copy()
    line[unknown, at.SPEED, 3] = 39.0
    views = [PLAN.observe(s, np.array([2]), 0.1)[unknown] for s in (state, state._replace(line=line))]
    assert views[0].tobytes() == views[1].tobytes()
    assert ((plan_of(state, 2)["coast_rear_time"] == 0.0) == unknown).all()


def test_agent__follows_the_plan_anew_at_every_decision() -> None:
    game = eb.open_game("paper-random")[1]
    state = game.reset(PAPER.sample(40, 7))
    agent = eb.make_agent("plan")
    command, memory = agent.act(state, agent.begin(state, 2), 2)
    np.testing.assert_allclose(command, plan_of(state, 2)["action"] * 7.0, rtol=1e-6)
    assert memory is None
    result = eb.evaluate("paper-random", "full_brake,plan,e_v2x_bm", episodes=200, harm_count="honest")
    means = {name: result[name]["honest_cost"].mean() for name in result}
    assert means["plan"] < 1.03 * means["e_v2x_bm"] < means["full_brake"]
    with refused("agent 'plan:3': plan takes no argument"):
        eb.make_agent("plan:3")


def test_agent__needs_no_more_than_messages() -> None:
    result = eb.evaluate("cooperation-1-front", "plan", episodes=20)
    assert result.knows["plan"] == "messages" and np.isfinite(result["plan"]["honest_cost"]).all()
