"""Possible lines by hand, the agent that plans for them, and what was not received."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams
from ethbrake_marl.agents.team import Team, play, play_to_end
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.certified.estimated import PossibleLines, hypercube, in_order
from ethbrake_marl.motion.layout import BRAKING, GAP, HIT, LATENCY, MASS, OWN_LATENCY, SPEED
from tests.refused import refused

BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")
CHANCE = {"preset": "congested", "silent_links": 0.0}  # vehicle_3 reacts after the latest message
NO_MASS = ["place", "speed", "acceleration", "braking_capacity", "latency"]
DEAF = BASE.replace(
    v2x={"preset": "paper", "hears": "front"}, gaps_m=[7.0, {"uniform": [5, 10]}],
    speeds_mps=[20.0, 20.0, {"uniform": [18, 22]}],
)  # fmt: skip


def lines_at(
    scenario: eb.Scenario, n: int = 20, steps: int = 0, action: float = 0.0
) -> tuple[PossibleLines, State, State]:
    """Median line before any message, the true states after some steps, and the median lines then."""
    loaded, game = eb.open_game(scenario)
    line, alert = PossibleLines.of(loaded, 2, 1), loaded.sample(n, 7)
    state = game.reset(alert)
    median = line.with_received(state, game.reset(line.at_alert(alert, state)))
    for _ in range(steps):
        state = game.step(state, np.full((n, 1), action))[0]
        median = line.with_received(state, game.follow(median, np.full((n, 1), action))[0])
    return line, state, median


# ------------------------------------------------------------------------------------------------ lines by hand


def test_the_line_is_the_true_one__where_everything_is_known() -> None:
    for scenario in (BASE, BASE.replace(v2x="nominal")):
        _, state, median = lines_at(scenario, steps=9, action=-0.5)
        known = (state.know[:, 2, 1:] <= state.time_s[:, np.newaxis]).all(axis=1)
        assert known.sum() > 10
        np.testing.assert_allclose(median.line[known][:, [SPEED, GAP], :-1], state.line[known][:, [SPEED, GAP], :-1])
        np.testing.assert_array_equal(median.car[known][:, [MASS, BRAKING]], state.car[known][:, [MASS, BRAKING]])
    _, state, median = lines_at(BASE, steps=9, action=-0.5)
    np.testing.assert_array_equal(median.line, state.line)


def test_who_is_not_known_is_in_the_middle_of_the_ranges_and_follows_its_script() -> None:
    # Vehicle 3 is never heard: at the alert 7.5 m behind, at 20 m/s; it coasts to 0.8 s, then brakes with 6. At 1 s it
    # has made 20 m less 0.5 * 6 * 0.2^2 = 0.12 m, and Vehicle 2, with 20 m/s and no command, 20 m.
    _, state, median = lines_at(DEAF, 40, steps=5)
    free = ~state.pair_hit[:, 0] & (state.speeds_mps[:, 1] == 20.0)
    np.testing.assert_allclose(state.time_s, 1.0)
    assert free.sum() > 20
    np.testing.assert_allclose(median.gaps_m[free, 1], 7.5 + 0.12)
    np.testing.assert_allclose(median.speeds_mps[free, 2], 20.0 - 6.0 * 0.2)
    np.testing.assert_allclose(median.gaps_m[:, 0], state.gaps_m[:, 0], atol=1e-9)
    assert (median.commands_mps2[:, 2] == -6.0).all()


def test_an_old_message__is_moved_on_by_the_script_to_the_truth() -> None:
    channel = {
        "preset": "paper",
        "link_latency_s": 0.2,
        "persistence": "periodic",
        "senses": "front",
        "sensing_s": [5, 5],
    }
    for steps in range(12):
        _, state, median = lines_at(BASE.replace(v2x=channel), 40, steps, action=-1.0)
        free = ~state.pair_hit.any(axis=1)
        np.testing.assert_allclose(
            median.line[free][:, [SPEED, GAP], :-1], state.line[free][:, [SPEED, GAP], :-1], rtol=0.0, atol=1e-9
        )
    assert free.sum() > 3


def test_a_piece_that_messages_lack__is_the_middle_of_its_range() -> None:
    base = BASE.replace(mass_t=[4.5, 5.5, {"uniform": [2.0, 9.0]}], braking_capacity_mps2={"uniform": [6, 8]})
    tells = {"vehicle_1": ["place", "speed", "mass"], "vehicle_3": ["place", "speed", "braking_capacity"]}
    _, state, median = lines_at(base.replace(v2x={"tells": tells}))
    np.testing.assert_allclose(median.gaps_m, state.gaps_m, atol=1e-9)
    np.testing.assert_allclose(median.speeds_mps, state.speeds_mps)
    assert (median.mass_t[:, 2] == 5.5).all() and (median.mass_t[:, 0] == state.mass_t[:, 0]).all()
    assert (median.braking_capacity_mps2[:, 0] == 7.0).all()
    assert (median.braking_capacity_mps2[:, 2] == state.braking_capacity_mps2[:, 2]).all()


def test_who_reacts_later_than_it_says__is_believed_to_react_from_then_on() -> None:
    """The alert reaches Vehicle 3 late; a message tells Vehicle 2 that Vehicle 3 does not brake yet."""
    _, state, median = lines_at(BASE.replace(v2x=CHANCE, latency_s=[0, 0.1, 0.1]), 200, steps=2)
    late = (state.car[:, LATENCY, 3] > state.time_s) & (state.know[:, 2, 3] <= state.time_s)
    assert late.any() and (median.car[late, OWN_LATENCY, 3] == 0.1).all()
    np.testing.assert_allclose(median.speeds_mps[late, 2], state.speeds_mps[late, 2])
    assert (median.car[late, LATENCY, 3] >= state.time_s[late]).all()


def test_in_order__who_is_not_known_stays_between_those_who_are() -> None:
    place, known = np.array([[0.0, 9.0, 4.0, 3.0, 7.0]]), np.array([[True, False, True, False, False]])
    assert in_order(place, known).tolist() == [[0.0, 4.0, 4.0, 4.0, 7.0]]


# ------------------------------------------------------------------------------------------------ several lines


def test_hypercube__has_a_number_in_each_part_and_no_order() -> None:
    numbers = hypercube(8)(40, (3,))
    np.testing.assert_array_equal(np.sort(numbers, axis=0), np.tile((np.arange(8)[:, np.newaxis] + 0.5) / 8, 40))
    assert len(np.unique(numbers.argsort(axis=0), axis=1).T) > 35
    assert not np.array_equal(numbers, hypercube(8)(40, (4,))) and (hypercube(1)(40, (3,)) == 0.5).all()


def test_possible_lines__have_the_ranges_of_what_is_not_known() -> None:
    agent = eb.make_agent("plan:estimated", scenario=DEAF)
    alert = DEAF.sample(4, 7)
    line = agent.begin(alert, 2).line  # type: ignore[union-attr]
    assert line[0, :, SPEED, 3].min() < 18.5 and line[0, :, SPEED, 3].max() > 21.5
    assert (np.ptp(line[:, :, GAP, 1], axis=1) == 0.0).all() and (np.ptp(line[:, :, GAP, 2], axis=1) > 4.0).all()


def test_who_strikes_a_vehicle_unseen__is_at_it_from_then_on() -> None:
    _, game = eb.open_game(DEAF)
    agent, touched = eb.make_agent("plan:estimated", scenario=DEAF), 0
    agent = replace(agent, layers=game.layers)  # type: ignore[type-var]
    for _, state in play(game, DEAF.sample(40, 7), Team("plan", {2: agent})):
        memory = state.memories[2]
        struck = state.pair_hit[:, 1] & ~state.ended & (memory.weight.min(axis=1) < 1.0)
        touched += struck.sum()
        assert (memory.weight.max(axis=1) == 1.0).all()
    assert touched > 10


# ------------------------------------------------------------------------------------------------ harm


def test_where_everything_is_known__it_is_the_plan_with_fewer_candidates() -> None:
    agents = {"plan": replace(eb.make_agent("plan", scenario=BASE), candidates=150), "estimated": "plan:estimated"}
    result = eb.evaluate(BASE, agents, episodes=20)
    np.testing.assert_allclose(result["estimated"]["honest_cost"], result["plan"]["honest_cost"], atol=0.5)


@pytest.mark.parametrize(
    ("scenario", "share"),
    [("cooperation-1-front", 0.97), (BASE.replace(v2x={"preset": "nominal", "tells": NO_MASS}), 0.6)],
    ids=["front", "no mass"],
)
def test_several_lines__are_better_than_a_line_without_the_vehicle(scenario: Any, share: float) -> None:
    result = eb.evaluate(scenario, "plan,plan:estimated", episodes=80)
    means = {name: result[name]["honest_cost"].mean() for name in result}
    assert means["plan:estimated"] < share * means["plan"]


# ------------------------------------------------------------------------------------------------ knowledge


CHANNELS = {
    "front alone": {"preset": "paper", "hears": "front"},
    "no capacity": {"preset": "blocked", "tells": ["place", "speed", "latency", "mass"]},
}


def decided(scenario: eb.Scenario, alert: State) -> tuple[Any, Any]:
    """Vehicle 2's commands at its first four decisions, and whether it has received or felt Vehicle 3."""
    _, game = eb.open_game(scenario)
    team, commands, aware = Team("plan", {2: eb.make_agent("plan:estimated", scenario=scenario)}), [], []
    for k, (_, state) in enumerate(play(game, alert, team)):
        commands.append(state.wanted[:, 2])
        aware.append((state.know[:, 2, 3] <= state.time_s) | (state.line[:, HIT, 2] == 1.0) | (state.time_s > 1.2))
        if k == 4:
            return np.array(commands[1:]), np.array(aware[:-1])
    raise AssertionError


@pytest.mark.parametrize("channel", CHANNELS)
def test_what_was_not_received__changes_no_command(channel: str) -> None:
    scenario = BASE.replace(v2x=CHANNELS[channel])
    alert, rng = scenario.sample(60, 7), np.random.default_rng(0)
    car, line = alert.car.copy(), alert.line.copy()
    if channel == "no capacity":
        car[:, BRAKING, 3] += 1.0  # it reacts at 0.8 s at the earliest
    else:
        line[:, SPEED, 3], line[:, GAP, 2] = rng.uniform(18.0, 19.0, 60), rng.uniform(9.0, 10.0, 60)
        car[:, MASS, 3] += 3.0
    one, two = (decided(scenario, worlds) for worlds in (alert, alert._replace(car=car, line=line)))
    unaware = ~(one[1] | two[1])
    if channel == "no capacity":
        unaware = np.zeros((4, 60), bool)
        unaware[:2] = alert.car[:, LATENCY, 2] <= 0.6
    assert unaware.sum() > 10 and (one[0] == two[0])[unaware].all()


# ------------------------------------------------------------------------------------------------ doors


@pytest.mark.parametrize("name", ["cooperation-1-front", "benchmark-noisy", "benchmark-blocked"])
def test_no_world_depends_on_the_batch(name: str) -> None:
    scenario = eb.load_scenario(name)
    _, game = eb.open_game(scenario)
    worlds, team = scenario.sample(5, 3), make_teams("plan:estimated", scenario)["plan:estimated"]
    whole, alone = play_to_end(game, worlds, team), play_to_end(game, worlds.take([4]), team)
    np.testing.assert_array_equal(whole.line[4], alone.line[0])


def test_table_says_what_it_knows() -> None:
    assert [*eb.evaluate(DEAF, "plan:estimated", episodes=1).knows.values()] == ["estimated model"]


REFUSED: dict[str, Callable[[], object]] = {
    "this is a mixture; give one of": lambda: eb.evaluate("mixture-delays", "plan:estimated", episodes=2),
    "but vehicle_3 is driven by 'idm'": lambda: eb.make_agent(
        "plan:estimated", scenario=BASE.replace(roles={"vehicle_2": "learner", "vehicle_3": "idm"})
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_use__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()
