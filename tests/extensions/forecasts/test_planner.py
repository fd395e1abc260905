"""The agent ``plan``: what a second and third phase win, what it must not depend on, and plans that messages tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.team import Team, play, play_to_end
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.episode.plans import CHANGES, COMMANDS, PHASES, PLANS_KEY
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.forecasts.contacts import FORECAST_S
from ethbrake_marl.extensions.forecasts.planner import foresee, make_plans, no_plans
from ethbrake_marl.motion import layout as at
from tests.episode.lines import later, state_of
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
FEW = 60  # candidates: enough for what does not depend on their number


def planner(scenario: eb.Scenario, name: str = "plan", **changes: Any) -> Any:
    return replace(eb.make_agent(name, scenario=scenario), **{"candidates": FEW, **changes})


def costs_of(scenario: eb.Scenario, agent: Any, worlds: State, layers: tuple[Layer, ...] = ()) -> np.ndarray:
    _, game = eb.open_game(scenario)
    game = game.with_layers(layers) if layers else game
    team = Team(agent.name, {int(body): agent for body in game.settings.learners})
    return play_to_end(game, worlds, team).harm("honest")


def test_plan__by_hand() -> None:
    # Vehicle 1 brakes at 4 m/s2 from 20 m/s and stops after 50 m. Vehicle 2, 30 m behind, stops without contact if it
    # brakes at 2.5 m/s2, half of its capacity, or a little more. Of the eighths above, 5/8 to 8/8, it takes the middle.
    state = later(state_of([30.0], [20.0, 20.0], braking_capacity_mps2=[4.0, 5.0]), [-4.0, 0.0], 1e-9)
    agent = planner(PAPER)
    command, memory = agent.act(state, agent.begin(state, 2), 2)
    assert command[0] == memory.plan[0, COMMANDS.start] == -0.8125 * 5.0
    alone = state._replace(know=np.full_like(state.know, np.inf))
    assert agent.act(alone, agent.begin(alone, 2), 2)[0][0] == -5.0  # nothing known: full braking


def test_phases__are_worth_what_they_promise() -> None:
    names = "full_brake,e_v2x_bm,plan:1,plan:2,plan"
    result = eb.evaluate("paper-random", names, episodes=150, seed=11)
    full, model, one, two, three = (result[name]["honest_cost"].mean() for name in names.split(","))
    assert one < 1.02 * model < 0.8 * full
    assert three < two < 0.92 * one


@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "stress-wide", "benchmark-truck"])
def test_forecast_cost__is_what_the_game_counts(name: str) -> None:
    # Vehicle 2 knows the line, and the others brake fully: a plan costs what was forecast, if all come to rest.
    scenario = eb.load_scenario(name)
    _, game = eb.open_game(scenario)
    state, bodies = game.reset(scenario.sample(40, 3)), np.array([2])
    plans, costs = make_plans(
        state, foresee(state, 2), no_plans(state), np.full(40, np.inf), bodies, phases=PHASES, reaction_s=0.0,
        time_step_s=scenario.time_step_s, count=HONEST, candidates=3,
    )  # fmt: skip
    last, rows = state, np.arange(40)
    while not last.ended.all():
        phase = (plans[:, CHANGES, 2] < last.time_s[:, np.newaxis] + 1e-6).sum(axis=1)
        command = plans[rows, COMMANDS.start + phase, 2]
        last, _ = game.step(last, np.maximum(command / last.braking_capacity_mps2[:, 1], -1.0)[:, np.newaxis])
    met = ~last.moving & (last.time_s <= state.time_s + FORECAST_S)
    assert costs[met, 0] == pytest.approx(last.harm("honest")[met], rel=1e-6, abs=1e-6)
    assert met.sum() > 5 and (last.line[met][:, at.PUSHED] > 0.0).any()


def test_changes_of_phase__fall_on_decisions() -> None:
    for step_s in (0.05, 0.1, 0.5):
        scenario = PAPER.replace(time_step_s=step_s)
        _, game = eb.open_game(scenario)
        state, agent = game.reset(scenario.sample(30, 3)), planner(scenario)
        _, memory = agent.act(state, agent.begin(state, 2), 2)
        steps = (memory.plan[:, CHANGES] - state.time_s[:, np.newaxis]) / step_s
        assert (np.abs(steps - steps.round()) < 1e-6).all() and (steps[:, 0] > 0.5).all()
        assert (np.diff(memory.plan[:, CHANGES], axis=1) > -1e-9).all()


@pytest.mark.parametrize("step_s", [0.05, 0.2, 0.5])
def test_time_step__hardly_matters(step_s: float) -> None:
    costs = [
        costs_of(scenario, planner(scenario, candidates=200), scenario.sample(60, 5)).mean()
        for scenario in (PAPER, PAPER.replace(time_step_s=step_s))
    ]
    assert abs(costs[1] - costs[0]) < 0.5


@pytest.mark.parametrize(
    "name", ["paper-random", "paper-random-obstacle", "realistic-truck-buildup", "benchmark-blocked", "messages-noisy"]
)
def test_world__has_the_same_plan_in_every_batch(name: str) -> None:
    scenario = eb.load_scenario(name)
    agent, worlds = planner(scenario), scenario.sample(16, 7)
    order, costs = np.random.default_rng(0).permutation(16), costs_of(scenario, agent, worlds)
    np.testing.assert_array_equal(costs_of(scenario, agent, worlds.take(order)), costs[order])
    alone = [costs_of(scenario, agent, worlds.take([k]))[0] for k in range(4)]
    np.testing.assert_array_equal(alone, costs[:4])


class Scrambled(Layer):
    """Gives every value of bodies that a vehicle does not know another value."""

    def seen(self, state: State, body: int) -> State:
        unknown = state.know[:, body] > state.time_s[:, np.newaxis]
        unknown[:, [0, body]] = False
        line, car = state.line.copy(), state.car.copy()
        for row in (at.SPEED, at.FORCE):
            line[:, row] = np.where(unknown, 3.2 + row, line[:, row])
        pair_unknown = unknown[:, 1:-1] | unknown[:, 2:]
        line[:, at.GAP, 1:-1] = np.where(pair_unknown, 1.2, line[:, at.GAP, 1:-1])
        for row in range(at.CAR_ROWS):
            if row != at.RESTITUTION:
                car[:, row] = np.where(unknown, 1.7 + row, car[:, row])
        return state._replace(line=line, car=car, wanted=np.where(unknown, -2.2, state.wanted))


@pytest.mark.parametrize("name", ["benchmark-blocked", "cooperation-1-front", "cooperation-4-congested"])
def test_unknown_values__change_nothing(name: str) -> None:
    scenario = eb.load_scenario(name)
    worlds = scenario.sample(20, 7)
    costs = [costs_of(scenario, planner(scenario), worlds, layers) for layers in ((Scrambled(),), (Layer(),))]
    np.testing.assert_array_equal(*costs)


def test_units__change_nothing() -> None:
    scenario = eb.load_scenario("realistic-truck")
    worlds = scenario.sample(20, 7)
    costs = []
    for factor in (1.0, 4.0):
        car = worlds.car.copy()
        car[:, at.MASS] *= factor
        costs.append(costs_of(scenario, planner(scenario), worlds._replace(car=car)))
    np.testing.assert_allclose(*costs, rtol=1e-12)


def test_irrelevant_vehicle__changes_nothing() -> None:
    four = PAPER.replace(
        vehicles=4, gaps_m=[7, 8, 200], braking_capacity_mps2=[6, 7, 6, 6], driving_capacity_mps2=6, mass_t=5,
        latency_s=[0, 0.5, 0.8, 0.8], early_impacts="keep",
    )  # fmt: skip
    _, game = eb.open_game(four)
    state, agent = game.reset(four.sample(40, 7)), planner(four)
    line, car, know, wanted = state.line[:, :, :4], state.car[:, :, :4], state.know[:, :4, :4], state.wanted[:, :4]
    three = state._replace(line=line, car=car, know=know, wanted=wanted, memories={})
    for other, same in ((three, True), (without_gap(state), False)):
        commands = [agent.act(one, agent.begin(one, 2), 2)[0] for one in (state, other)]
        assert np.array_equal(*commands) == same


def without_gap(state: State) -> State:
    line = state.line.copy()
    line[:, at.GAP, 3] = 5.0
    return state._replace(line=line)


def test_reaction__lets_the_vehicle_behind_coast_until_it_sees_braking() -> None:
    # 10 m behind drives a human, who brakes 1 s after Vehicle 2: braking a little and early costs nothing, and a plan
    # that expects him to brake at once brakes later.
    state = later(state_of([60.0, 10.0], [20.0, 20.0, 20.0], braking_capacity_mps2=6.0), [-6.0, 0.0, 0.0], 1e-9)
    hopeful, careful = planner(PAPER), planner(PAPER, "plan:reaction=1.0")
    plans = [agent.act(state, agent.begin(state, 2), 2)[1] for agent in (hopeful, careful)]
    assert careful.reaction_s == 1.0 and not np.array_equal(plans[0].plan, plans[1].plan)
    assert plans[1].plan[0, COMMANDS.start] > plans[0].plan[0, COMMANDS.start]


@pytest.mark.parametrize(
    "name", ["plan:0", "plan:4", "plan:x", "plan:reaction=", "plan:reaction=0", "plan:reaction=11", "plan:reaction=-1"]
)
def test_bad_argument__is_refused(name: str) -> None:
    with refused(f"agent '{name}': must be plan, plan:1 or plan:2"):
        eb.make_agent(name, scenario=PAPER)


def test_plan__is_refused_where_decisions_come_at_other_times() -> None:
    agent = eb.make_agent("plan", scenario=PAPER)
    with refused("agent 'plan': was made for decisions every 0.1 s, but scenario 'paper-random' has one every 0.2 s"):
        eb.evaluate(PAPER.replace(time_step_s=0.2), {"plan": agent}, episodes=2)


def test_plan__needs_a_scenario() -> None:
    with refused("agent 'plan': needs a scenario"):
        eb.make_agent("plan")


def test_plan__minimises_the_count_that_it_is_told() -> None:
    result = {
        count: eb.evaluate("paper-random", "plan", episodes=60, harm_count=count)["plan"]
        for count in ("first", "honest")
    }
    assert result["first"]["first_impact_harm"].mean() < result["honest"]["first_impact_harm"].mean()
    assert result["honest"]["honest_cost"].mean() < result["first"]["honest_cost"].mean()


def telling(name: str, *pieces: str, **channel: Any) -> eb.Scenario:
    tells = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass", *pieces]
    return eb.load_scenario(name).replace(v2x={"preset": "paper", "tells": tells, **channel}, early_impacts="keep")


def test_told_plans__are_worth_more_than_constant_forces() -> None:
    pytest.importorskip("ethbrake_marl.extensions.messages")
    costs = []
    for scenario in (telling("cooperation-4-all"), telling("cooperation-4-all", "plan")):
        costs.append(costs_of(scenario, planner(scenario, candidates=150), scenario.sample(60, 7)).mean())
    assert costs[1] < 0.6 * costs[0]


@pytest.mark.parametrize(
    "channel", [{}, {"preset": "nominal"}, {"preset": "nominal", "persistence": "periodic", "loss_begins": 0.4}]
)
def test_told_plan__is_that_of_the_newest_message(channel: dict[str, Any]) -> None:
    pytest.importorskip("ethbrake_marl.extensions.messages")
    scenario = telling("cooperation-4-all", "plan", **channel)
    _, game = eb.open_game(scenario)
    agent, told, ages = planner(scenario), [], 0
    for _, state in play(game, scenario.sample(8, 7), Team("plan", dict.fromkeys((1, 2, 3), agent))):
        told.insert(0, state.memories[1].plan)
        heard = replace(agent, layers=game.layers).predictable(state, 2).memories[PLANS_KEY][:, :, 1]
        for k in np.flatnonzero(~state.ended & ~np.isnan(heard[:, COMMANDS.start])):
            age = [np.array_equal(plan[k], heard[k]) for plan in told].index(True)
            assert age == 0 or channel.get("persistence")
            ages += age
    assert (ages > 0) == ("persistence" in channel)


def test_liar__tells_a_plan_of_coasting() -> None:
    pytest.importorskip("ethbrake_marl.extensions.messages")
    scenario = telling("cooperation-4-all", "plan", reports={"liar": "vehicle_1"})
    _, game = eb.open_game(scenario)
    agent, heard = replace(planner(scenario), layers=game.layers), 0
    for _, state in play(game, scenario.sample(8, 7), Team("plan", dict.fromkeys((1, 2, 3), agent))):
        plans = agent.predictable(state, 2).memories[PLANS_KEY][:, :, 1]
        known = ~np.isnan(plans[:, COMMANDS.start])
        heard += known.sum()
        assert (plans[known][:, COMMANDS] == 0.0).all()
        assert np.array_equal(agent.predictable(state, 1).memories[1].plan, state.memories[1].plan, equal_nan=True)
    assert heard > 0


def test_features__show_the_plan_that_a_neighbour_has_told() -> None:
    pytest.importorskip("ethbrake_marl.extensions.messages")
    names = ["plan_known", *(f"plan_command_{p}" for p in (1, 2, 3)), "plan_change_1", "plan_change_2"]
    scenario = telling("cooperation-4-all", "plan")
    _, game = eb.open_game(scenario, observation=[f"front_1.{name}" for name in names])
    states = list(play(game, scenario.sample(8, 7), Team("plan", dict.fromkeys((1, 2, 3), planner(scenario)))))
    _, state = states[9]  # Vehicle 2 has known of the others since 0.5 s
    seen, plan = game.observe(state, np.array([2]))[0], state.memories[1].plan
    seen = seen * [feature.scale for feature in game.views[2].features]
    running = ~state.ended & (seen[:, 0] == 1.0)
    assert running.any()
    np.testing.assert_allclose(seen[running, 1:4], plan[running][:, COMMANDS], rtol=1e-5)
    left = np.clip(plan[:, CHANGES] - state.time_s[:, np.newaxis], 0.0, 8.0)
    np.testing.assert_allclose(seen[running, 4:], left[running], atol=1e-5)


def test_feature_group__is_the_first_plan_of_the_agent() -> None:
    _, game = eb.open_game("paper-random", observation=["plan", "forecast"])
    worlds = PAPER.sample(40, 7)
    state, agent = game.reset(worlds), planner(PAPER, candidates=9)
    shown = {
        feature.name.partition(".")[2]: column * feature.scale
        for feature, column in zip(game.views[2].features, game.observe_alike(state, [2])[:, 0].T, strict=True)
    }
    command, memory = agent.act(state, agent.begin(state, 2), 2)
    np.testing.assert_allclose(shown["action"] * 7.0, command, rtol=1e-5)
    left = np.clip(memory.plan[:, CHANGES] - state.time_s[:, np.newaxis], 0.0, 4.0)
    np.testing.assert_allclose(np.stack([shown["change_1"], shown["change_2"]], axis=1), left, atol=1e-5)
    assert (shown["plan_speed"] <= shown["constant_speed"] + 1e-6).all()
    assert (shown["constant_speed"] <= shown["brake_speed"] + 1e-6).all()
    assert (shown["plan_speed"] < shown["constant_speed"] - 0.1).any() and (shown["known"] == 1.0).all()
    assert (shown["strongest_action"] <= shown["weakest_action"]).all()
