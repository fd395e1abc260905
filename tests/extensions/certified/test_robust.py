"""Intervals, the members that stand for them, and the robust shield, whose bound holds in every member."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.extensions.certified.robust import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.motion.layout import BRAKING, LATENCY, OWN_LATENCY
from tests.extensions.certified.attack import UNCERTAINTIES, Wrongly, attacked, robust
from tests.refused import refused
from tests.shields.attack import WAYS

PAPER = eb.load_scenario("paper-random").replace(early_impacts="keep")
WORLDS = PAPER.replace(
    gaps_m=[10, 8], speeds_mps=[20, 18, 39.9], braking_capacity_mps2=[8, 6, 5], latency_s=[0.0, 0.4, 0.7],
    driving_capacity_mps2=2, mass_t=[1, 2, 4],
).sample(1, 7)  # fmt: skip
TWICE = WORLDS.take([0, 0])


def members(text: str, worlds: State = WORLDS) -> State:
    return parse_uncertainty(text).members(worlds)


# ------------------------------------------------------------------------------------------------ members


@pytest.mark.parametrize(
    ("text", "count"), [("latency_s=0.1", 1 + 2**3), ("latency_s=0.1,gaps_m=1", 1 + 2**5), ("latency_s=0,gaps_m=0%", 1)]
)
def test_members__of_every_vehicle_where_none_is_named_and_none_of_no_width(text: str, count: int) -> None:
    assert members(text).n == count


def test_members__are_the_world_itself_and_every_corner() -> None:
    found = members("gaps_m.pair_1=0.5,mass_t.vehicle_3=10%", TWICE)
    assert found.gaps_m[:, 0].tolist() == 2 * [10.0, 9.5, 10.5, 9.5, 10.5]
    assert found.mass_t[:, 2] == pytest.approx(2 * [4.0, 3.6, 3.6, 4.4, 4.4], abs=1e-12)
    assert (found.gaps_m[:, 1] == 8.0).all() and (found.latency_s[:, 1] == 0.4).all() and WORLDS.gaps_m[0, 0] == 10.0


def test_members__stay_within_what_is_possible() -> None:
    found = members("latency_s.vehicle_1=0.1,speeds_mps.vehicle_3=5")
    assert found.latency_s[:, 0].tolist() == [0.0, 0.0, 0.1, 0.0, 0.1]
    assert found.speeds_mps[:, 2] == pytest.approx([39.9, 34.9, 34.9, 40.0, 40.0])


def test_members__whose_script_brakes_fully_do_so_with_their_own_capacity() -> None:
    found = members("braking_capacity_mps2.vehicle_1=25%")
    assert found.commands_mps2[:, 0].tolist() == [-8.0, -6.0, -10.0] and (found.commands_mps2[:, 2] == -5.0).all()


def test_latency__moves_the_news_too_unless_a_channel_brings_them() -> None:
    found = members("latency_s.vehicle_2=0.1")
    assert (found.know[:, 2, 3] == found.car[:, LATENCY, 2]).all() and len(set(found.car[:, OWN_LATENCY, 2])) == 3
    told = eb.load_scenario("cooperation-2-blocked").sample(1, 7)
    found = members("latency_s.vehicle_2=0.1", told)
    assert len(set(found.latency_s[:, 1])) == 3 and (found.know == told.know).all()
    assert (found.car[:, OWN_LATENCY] == told.car[:, OWN_LATENCY]).all()


def test_draw__is_inside_the_box_or_at_a_corner() -> None:
    worlds, uncertainty = WORLDS.take(np.zeros(50, int)), parse_uncertainty("gaps_m=0.5,speeds_mps.vehicle_1=2")
    inside, corners = (uncertainty.draw(worlds, np.random.default_rng(0), corners=each) for each in (False, True))
    assert (abs(inside.gaps_m - worlds.gaps_m) < 0.5).all() and len(set(inside.gaps_m[:, 0])) == 50
    every, drawn = (
        {tuple(row) for row in np.hstack([some.gaps_m, some.speeds_mps])}
        for some in (uncertainty.members(WORLDS), corners)
    )
    assert drawn <= every and len(drawn) == 8


def test_parse__reads_entries_between_commas_or_colons() -> None:
    text = "braking_capacity_mps2=5%,latency_s.vehicle_2=0.1,gaps_m.pair_1=0.5"
    for form in (text, text.replace("=", " = ").replace(",", " ,"), text.replace(",", ":")):
        found = parse_uncertainty(form)
        assert [(each.half_width, each.number) for each in found.intervals] == [(0.05, None), (0.1, 2), (0.5, 1)]
        assert [each.relative for each in found.intervals] == [True, False, False]


# ------------------------------------------------------------------------------------------------ the shield


@settings(max_examples=7)
@given(
    intervals=st.sampled_from(list(UNCERTAINTIES)),
    count=st.sampled_from(["first", "total"]),
    way=st.sampled_from(list(WAYS)),
    seed=st.integers(0, 10_000),
)
def test_true_corners__do_at_most_the_bound_to_the_bit(intervals: str, count: str, way: str, seed: int) -> None:
    found = robust(intervals, count, way, 4, seed)
    assert found.above == found.rises == 0 and found.trusted.all()


def test_the_bound__is_the_harm_of_the_worst_corner() -> None:
    """Of 80 worlds with proposals some come close to their bound, and some do what step mode would not allow."""
    found = robust("gaps_m=0.5", "first", "random", 80, 5)
    assert (found.harm > 0.99 * found.first).sum() > 5 and found.replaced.sum() > 80


def test_no_width__is_step_mode_to_the_bit() -> None:
    agents = "ppo+step,ppo+robust:latency_s=0:mass_t=0%"
    result = eb.evaluate("paper-random", agents, episodes=40, harm_count="total").columns
    for column in ("total_harm", "replaced_actions"):
        step, wide = (each[column].tolist() for each in result.values())
        assert step == wide


# A front vehicle that stands, 15 m ahead of one at 14 m/s that brakes with at most 5 m/s2: 19.6 m to stop.
STANDING = eb.Scenario(
    name="two", vehicles=2, gaps_m=15, speeds_mps=[0, 14], braking_capacity_mps2=5, driving_capacity_mps2=5,
    mass_t=1, latency_s=0, restitution=0, roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
)  # fmt: skip
STOPS = STANDING.replace(speeds_mps=[0, 10])  # 10 m to stop


def first(scenario: eb.Scenario, **options: Any) -> Any:
    loaded, game = eb.open_game(scenario)
    return game._replace(shield=RobustShield(**options)).reset(loaded.sample(1, 7)).memories["shield"]


def test_bound_at_the_alert__by_hand() -> None:
    # Full braking strikes with 14^2 - 2 x 5 x 15 = 46; 2 m nearer and 1 m/s faster with 15^2 - 130 = 95.
    assert first(STANDING, uncertainty="gaps_m=0").price == pytest.approx([46.0])
    assert first(STANDING, uncertainty="gaps_m=2,speeds_mps.vehicle_2=1").price == pytest.approx([95.0])


@pytest.mark.parametrize(
    ("intervals", "steps"),
    [
        ("braking_capacity_mps2.vehicle_2=20%", 2),  # 12.5 m to stop with 4 m/s2: 2.5 m
        ("mass_t=50%", 5),  # changes nothing before an impact
    ],
)
def test_coasting_is_let_through__as_long_as_the_worst_corner_can_still_stop(intervals: str, steps: int) -> None:
    loaded, game = eb.open_game(STOPS)
    game = game._replace(shield=RobustShield(uncertainty=intervals))
    state, coasts = game.reset(loaded.sample(1, 7)), 0
    while not state.ended.all():
        state, _ = game.step(state, np.zeros((1, 1)))
        coasts += int(not state.memories["shield"].intervened[0, 1])
        if state.memories["shield"].intervened[0, 1]:
            break
    assert coasts == steps


@pytest.mark.parametrize(("gap", "trusted"), [(13.2, True), (12.9, False)])
def test_what_is_seen__outside_the_range_of_the_members_is_not_trusted(gap: float, trusted: bool) -> None:
    _, game = eb.open_game(STANDING)
    shield = Wrongly(STANDING.sample(1, 7), uncertainty="gaps_m=2,speeds_mps.vehicle_2=1")
    found = attacked(game, STANDING.replace(gaps_m=gap).sample(1, 7), shield, "first", "held", 0)
    assert found.trusted.tolist() == [trusted]


def test_a_shield_takes_rows_and_does_not_change_the_state() -> None:
    loaded, game = eb.open_game("paper-random")
    game = game._replace(shield=RobustShield(uncertainty="gaps_m=0.5"))
    state, proposed = game.reset(loaded.sample(6, 7)), np.linspace(-1.0, 1.0, 6)[:, np.newaxis]
    before, rows = state.memories["shield"].members.states.line.copy(), np.array([4, 1])
    whole, part = game.step(state, proposed)[0].take(rows), game.step(state.take(rows), proposed[rows])[0]
    np.testing.assert_array_equal(whole.line, part.line)
    np.testing.assert_array_equal(
        whole.memories["shield"].members.states.line, part.memories["shield"].members.states.line
    )
    np.testing.assert_array_equal(state.memories["shield"].members.states.line, before)
    assert (whole.memories["shield"].members.states.clock[..., 0] > state.time_s.min()).all()


def test_the_first_plan__is_the_best_constant_action_of_the_worst_corner_where_it_costs_least() -> None:
    scenario = eb.Scenario(
        name="between", vehicles=3, gaps_m=[6, 6], speeds_mps=20, braking_capacity_mps2=[8, 8, 5],
        driving_capacity_mps2=2, mass_t=1, latency_s=[0, 0.5, 0.5],
        roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"},
    )  # fmt: skip
    memory = first(scenario, uncertainty="gaps_m=3")
    _, game = eb.open_game(scenario)
    state = game.reset(members("gaps_m=3", scenario.sample(1, 7)))
    tried = [eb.price(game, state, np.full((5, 1, 1), -a), "honest").max() for a in np.linspace(0.0, 1.0, 41)]
    assert memory.price[0] <= min(tried) + 1e-9
    alone = eb.price(game, state, np.repeat(memory.plan, 5, axis=0), "honest")
    assert memory.price[0] == alone.max() and len(set(alone)) > 2


# ------------------------------------------------------------------------------------------------ doors


def test_names_and_environments__put_it_around_a_policy() -> None:
    agent = eb.make_agent("ppo+robust:gaps_m=0.5:mass_t=10%", scenario="paper-random")
    assert str(agent.shield.uncertainty) == "gaps_m=0.5,mass_t=10%" and agent.name == "ppo+robust:gaps_m=0.5:mass_t=10%"
    env = eb.shield(eb.EthBrakeEnv("paper-random"), mode="robust", uncertainty="gaps_m=0.5", harm_count="total")
    info, over = env.reset(seed=7)[1], False
    while not over:
        *_, ended, cut, after = env.step([1.0])
        over = ended or cut
        assert after["shield_bound_harm"] <= info["shield_bound_harm"] and after["shield_trusted"]
        info = after
    assert info["world_total_harm"] <= info["shield_bound_harm"]


TEXTS = {  # an uncertainty as a text -> what is wrong with it, some only in a world
    "": "must be quantity=half-width",
    "latency_s=100%": "must be a finite number, or a share below 100 %",
    "latency_s.pair_1=0.1": "only gaps_m may name a pair",
    "latency_s=0.1,latency_s.vehicle_2=0.2": "intervals of the same quantity",
    "mass_t.vehicle_4=0.1": "there is no such vehicle, because the line has 3",
    "mass_t=1": "the value 1 of vehicle_1 in world 0 may be from 0 to 2; must be finite and in (0, 1000]",
    "latency_s=0.1,mass_t=0.1,speeds_mps=1,gaps_m=1": "at most 1024",
    "brake_rate_mps3=1": "declare brake_rate_mps3 in the scenario",
}


@pytest.mark.parametrize("text", TEXTS)
def test_uncertainty__as_a_text_is_refused(text: str) -> None:
    with refused(TEXTS[text]):
        members(text)


REFUSED: dict[str, Callable[[], object]] = {
    "shield 'ppo+robust:gaps_m=1': 'gaps_m=1' cannot follow the colon": lambda: eb.shield(
        eb.Team("ppo", {}), mode="robust:gaps_m=1", uncertainty="mass_t=1"
    ),
    "uncertainty = 0.1: must be a text": lambda: RobustShield(uncertainty=0.1),
    "the first decision may be as late as 1000.5 s": lambda: first(PAPER, uncertainty="latency_s.vehicle_2=1000"),
    "vehicle_3 of world 1 is to accelerate with -5.5 m/s2, which may be beyond its capacity": lambda: members(
        "braking_capacity_mps2.vehicle_3=10%", State.join([
            PAPER.replace(roles={"vehicle_3": role}).sample(1, 7) for role in ("constant:5", "constant:5.5")])
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_use__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_quantity__is_unknown() -> None:
    with refused("uncertain quantity 'friction'", UnknownName):
        parse_uncertainty("friction=0.1")


def test_capacity__is_that_on_the_road() -> None:
    wet = PAPER.replace(friction=0.4).sample(1, 7)
    assert members("braking_capacity_mps2.vehicle_2=10%", wet).car[:, BRAKING, 2] == pytest.approx(
        3.924 * np.array([1.0, 0.9, 1.1])
    )
