"""E-V2X-BM: hand cases of the closed form, and a coupled search that is not worse than a grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import make_agent, open_game
from ethbrake_marl.agents import e_v2x_bm
from ethbrake_marl.agents.e_v2x_bm import coupled, harms
from ethbrake_marl.agents.pairwise import CLOSED_FORM_CANDIDATES, find_candidates, harm_of_deceleration, meet, pairwise
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.layer import MODEL, STATE
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import at_alert, first_decision
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.motion.layout import BRAKING, LATENCY, SPEED, Floats
from tests.motion.lines import lines

PAPER = {
    "braking_capacity_mps2": [6.0, 7.0, 6.0],
    "mass_t": [4.5, 5.5, 5.9],
    "restitution": 0.1,
}  # of the paper's three vehicles


def alert(gaps: Any, speeds: Any, **settings: Any) -> State:
    line, car = lines(gaps, speeds, **settings)
    n, bodies = len(line), line.shape[2]
    return at_alert(line, car, np.zeros((n, bodies, bodies)), -car[:, BRAKING], np.full(n, -1))


def wide(n: int, vehicles: int, seed: int) -> State:
    """Lines far beyond the paper's ranges; a tenth of all gaps, speeds and latencies is 0."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0.0, 60.0, (n, vehicles - 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1))
    speeds, latency = rng.uniform(0.0, 35.0, (n, vehicles)), rng.uniform(0.0, 2.5, (n, vehicles))
    for part in (gaps, speeds, latency):
        part[rng.random(part.shape) < 0.1] = 0.0
    braking, mass = rng.uniform(1.0, 10.0, (n, vehicles)), rng.uniform(1.0, 20.0, (n, vehicles))
    return alert(gaps, speeds, braking_capacity_mps2=braking, latency_s=latency, mass_t=mass, restitution=0.1)


def wait_of(worlds: State) -> Floats:
    return worlds.car[:, LATENCY]


@pytest.mark.parametrize(
    ("pair", "expected"),
    [  # gap, front vehicle: speed, deceleration, onset; rear vehicle: the same
        ((8, 10, 4, 0, 10, 5, 5), 64.0),  # A: the front brakes, the rear coasts; the gap falls by 2 t^2: t = 2
        ((10, 4, 4, 0, 6, 5, 5), 36.0),  # A': the front stands after 2 m, the rear coasts 12 m at 6 m/s
        ((9, 20, 4, 0, 22, 2, 0), 40.0),  # B: both brake; 2^2 + 2 * 2 * 9
        ((10, 4, 4, 0, 10, 2, 0), 52.0),  # C: the front stands, the rear brakes; 100 - 2 * 2 * 12
        ((4, 10, 5, 3, 12, 5, 4), 4.0),  # both coast: 4 m at 2 m/s
        ((3, 10, 5, 9, 14, 2, 0), 4.0),  # the rear brakes, the front still coasts: 16 - 2 * 2 * 3
        ((4.5, 10, 6, 1, 13, 2, 0), 21.0),  # then both brake: after 1 s the gap is 2.5 and w 1; 1 + 2 * 4 * 2.5
        ((4, 10, 5, 9, 14, 2, 0), 0.0),  # a touch: 16 - 2 * 2 * 4
        ((4, 10, 5, 9, 14, 2 - 3e-12, 0), 0.0),  # still a touch: 2.4e-11
        ((4, 10, 5, 9, 14, 2 - 3e-6, 0), 2.4e-5),  # an impact
        ((12, 4, 4, 0, 10, 50 / 14, 0), 0.0),  # stops right behind
        ((4, 12, 2, 0, 10, 5, 0), 0.0),  # opens
        ((4, 12, 0, 0, 10, 0, 0), 0.0),  # opens, nobody brakes
        ((5, 0, 2, 0, 3, 0, 0), 9.0),  # the front stands, the rear has no brakes
        ((0, 12, 4, 0, 10, 1, 9), 4.0),  # opens from contact with w = -2, and closes again with 2
        ((0, 10, 4, 0, 10, 1, 9), 0.0),  # press against each other from the start
    ],
)
def test_first_impact_of_a_pair__by_hand(pair, expected):
    assert meet(*map(float, pair), math.inf)[0] == pytest.approx(expected, abs=1e-12)


def test_pair__is_moved_to_a_time():
    # 1 s both coast, 1 s the front brakes by 4: 10 - 2 * 2 + 2 = 8 m
    assert meet(10.0, 20.0, 4.0, 1.0, 18.0, 6.0, 9.0, 2.0) == (0.0, 12.0, 16.0, 18.0)


# gaps; speeds; latencies; ends of the interval without impacts; a* and H*; H of full braking: as in the paper. The last
# H* is printed as 22.2623, which belongs to the printed a*. By hand: a* = 18^2 / (2 (7 + 400/12 - 18 * 0.8)), and the
# rear pair meets with 11.76 a* - 51.2 = 22.26221.
GOLDEN = [
    ((10, 8), (20, 18, 20), (0.5, 0.8), ("4.71845", "5.01031"), (None, "0"), "28.98"),
    ((5, 9), (22, 18, 20), (0.5, 0.8), ("4.45872", "5.17021"), (None, "0"), "30.98"),
    ((7, 7), (20, 18, 20), (0.5, 0.8), ("5.17021", "4.84848"), ("5.17021", "4.03447"), "26.98"),
    ((7, 7), (20, 18, 20), (0.2, 0.8), (), ("4.41016", "6.94011"), "46.72"),
    ((7, 7), (20, 18, 20), (0.8, 1.2), (), ("6.24679", "22.26221"), "31.12"),
]


def as_printed(value: float, printed: str) -> str:
    return f"{value:.{len(printed.partition('.')[2])}f}"


@pytest.mark.parametrize(("gaps", "speeds", "latency", "ends", "best", "full"), GOLDEN)
def test_closed_form__has_every_printed_digit(gaps, speeds, latency, ends, best, full):
    world = alert(gaps, speeds, latency_s=[0.0, *latency], **PAPER)
    at = np.empty(CLOSED_FORM_CANDIDATES)
    parts = world.line[0], world.car[0, BRAKING], wait_of(world)[0], 2
    find_candidates(*parts, at)
    for end in ends:
        assert end in [as_printed(a, end) for a in at]
    found = [*(column[0] for column in pairwise(world, 2)), harm_of_deceleration(*parts, 7.0)]
    for value, printed in zip(found, (*best, full), strict=True):
        assert printed is None or as_printed(value, printed) == printed
    assert best[0] is not None or found[0] == pytest.approx(sum(map(float, ends)) / 2, abs=1e-5)


@pytest.mark.parametrize(
    ("body", "pair", "expected", "harm"),
    [  # gap; front vehicle: speed, capacity, onset; rear vehicle: the same; the best deceleration of `body`
        (2, (12, 4, 4, 0, 10, 8, 0), (100 / 28 + 8) / 2, 0.0),  # from 100 / 28 on it stops behind: 2 + 12 m
        (2, (2, 30, 3, 0, 33, 9, 0), (3 + 9 / 4 + 9) / 2, 0.0),  # touches while both brake: 3^2 = 2 (a - 3) 2
        (2, (10, 20, 2, 1, 28, 9, 0), (4 + 9) / 2, 0.0),  # the same, 1 s later: after 3 s both have 16 m/s
        (2, (4, 10, 5, 9, 14, 6, 0), (2 + 6) / 2, 0.0),  # touches while the front coasts: 4^2 = 2 * 2 * 4
        (2, (2, 10, 8, 3, 12, 1.5, 0), 1.0, 4e-10),  # strikes the coasting front lightly, or later hard: 2^2 = 2 * 2
        (2, (2, 10, 8, 1.5, 12, 1, 0), 8 / 9, 4 / 9),  # arrives when the front begins to brake: 2 = 3 - 1.5^2 a / 2
        (2, (4, 10, 5, 3, 12, 5, 4), 2.5, 4.0),  # both coast until they meet: all do the same
        (2, (8, 10, 4, 0, 10, 9, 5), 4.5, 64.0),  # the front brakes before it may
        (1, (5, 10, 12, 0, 10, 5, 0), 10 / 2, 0.0),  # up to 10 it stops 5 m ahead, where the rear one stops in 10
        (1, (2, 30, 9, 0, 33, 3, 0), 0.75 / 2, 0.0),  # touches while both brake: 3^2 = 2 (3 - a) 2
        (1, (15, 20, 9, 0, 26, 6, 1), 2 / 2, 0.0),  # the same, 1 s later: after 3 s both have 14 m/s
        (1, (17.5, 10, 9, 1, 20, 5, 0), 4 / 2, 0.0),  # after 1 s 10 m ahead of 15 m/s: 22.5 = 10 + 100 / (2 a)
        (1, (1, 10, 9, 0, 14, 2, 0), 0.0, 12.0),  # even if it coasts: 16 - 2 * 2 * 1
        (1, (20, 10, 8, 9, 14, 2, 0), 4.0, 0.0),  # the rear one is at rest before it brakes
        (1, (0, 10, 8, 0, 10, 5, 0.5), 4.0, 0.0),  # pressed together: no impact
    ],
)
def test_choice_for_one_pair__by_hand(body, pair, expected, harm):
    gap, front, front_braking, front_onset, rear, rear_braking, rear_onset = map(float, pair)
    latency, braking = [front_onset, rear_onset], [front_braking, rear_braking]
    found = pairwise(alert([gap], [front, rear], braking_capacity_mps2=braking, latency_s=latency), body)
    assert found.deceleration_mps2[0] == pytest.approx(expected, abs=1e-9)
    assert found.harm[0] == pytest.approx(harm, rel=1e-3 if harm < 1e-6 else 1e-12, abs=1e-14)


@pytest.mark.parametrize(
    ("gaps", "speeds", "settings", "expected", "harm"),
    [
        # The front pair meets while both coast, whatever Vehicle 2 does: 2^2. The rear one stops in 14.4 m, so Vehicle
        # 2 may stop in 9.4 m: 72 / 9.4 m/s2 and less do no further harm, and the middle of them is chosen.
        ([1.0, 5.0], [10.0, 12.0, 12.0], {"braking_capacity_mps2": [5.0, 8.0, 5.0], "latency_s": 1.0}, 36 / 9.4, 4.0),
        # H is 60 at 2.4 and at 6.4 m/s2, and more between: the first of two minima is chosen.
        (
            [5.0, 6.0],
            [10.0, 12.0, 12.0],
            {"braking_capacity_mps2": [8.0, 7.0, 3.0], "latency_s": [0.0, 0.0, 1.0]},
            2.4,
            60.0,
        ),
    ],
)
def test_closed_form__decides_ties(gaps, speeds, settings, expected, harm):
    deceleration, least = pairwise(alert(gaps, speeds, **settings), 2)
    assert least[0] == pytest.approx(harm, abs=1e-12) and deceleration[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("vehicles", "body"), [(3, 2), (5, 3)])
def test_closed_form__is_attained_and_not_above_a_grid(vehicles, body):
    worlds = wide(250, vehicles, seed=14 + body)
    deceleration, harm = pairwise(worlds, body)
    for k in range(worlds.n):
        parts = worlds.line[k], worlds.car[k, BRAKING], wait_of(worlds)[k], body
        most = worlds.car[k, BRAKING, body]
        assert 0.0 <= deceleration[k] <= most and harm_of_deceleration(*parts, deceleration[k]) == harm[k]
        assert harm[k] <= min(harm_of_deceleration(*parts, a) for a in np.linspace(0.0, most, 150)) + 1e-9
    assert 0.2 < np.mean(harm > 0.0) < 0.9


def test_pairwise__predicts_the_harm_of_the_physics_if_there_is_one_pair():
    worlds = wide(2000, 2, seed=5)
    for body in (1, 2):
        deceleration, harm = pairwise(worlds, body)
        happens = harms(worlds, body, deceleration[:, np.newaxis], "first", 1000.0)[0, :, 0]
        assert np.abs(happens - harm).max() < 1e-9


def test_pairwise__refuses_what_the_proof_excludes():
    worlds = wide(3, 3, seed=1)
    backward = worlds.line.copy()
    backward[2, SPEED, 1] = -0.1
    with pytest.raises(InvalidInput, match=r"^e_v2x_bm:pairwise does not cover backward, by which world 2 departs"):
        pairwise(worlds._replace(line=backward), 2)
    slow = alert([9.0], [20.0, 20.0], brake_rate_mps3=[np.inf, 12.0])
    with pytest.raises(InvalidInput, match=r"^e_v2x_bm:pairwise does not cover build-up, by which world 0 departs"):
        pairwise(slow, 1)


def test_coupled__takes_the_middle_of_what_does_no_harm_behind_and_ahead_of_gentle_brakes():
    rng = np.random.default_rng(25)
    gaps, speeds = rng.uniform(9.0, 16.0, (100, 2)), rng.uniform(18.0, 22.0, (100, 3))
    settings = {**PAPER, "latency_s": [0.0, 0.5, 0.8]}
    gentle = {**settings, "braking_capacity_mps2": [5.0, 7.0, 4.5]}
    others = alert(gaps, speeds, **gentle)
    best, closed = coupled(alert(gaps, speeds, **settings)._replace(wanted=others.wanted), 2), pairwise(others, 2)
    free = closed.harm == 0.0
    assert 10 < free.sum() < 90 and (best.harm[free] == 0.0).all()
    assert (best.deceleration_mps2[free] == closed.deceleration_mps2[free]).all()


def test_coupled__stays_off_the_edge_of_a_jump():
    # The least harm, 1.2376, ends at 5.93951 m/s2, from where a second impact makes it 1.6387.
    world = alert([7.59, 9.53], [20.07, 19.34, 20.35], latency_s=[0.0, 0.5, 0.8], **PAPER)
    best = coupled(world, 2, "first")
    around = best.deceleration_mps2[:, np.newaxis] + [-1e-9, 0.0, 1e-9, 3e-5]
    first, _ = harms(world, 2, around, "first", 8.0)[:, 0]
    assert first[:3] == pytest.approx([1.2376] * 3, abs=1e-4) and first[3] > 1.6
    assert best.harm[0] == first[1]


@pytest.mark.parametrize(("vehicles", "body", "count"), [(3, 2, "total"), (4, 3, "total")])
def test_coupled__is_not_worse_than_a_grid(vehicles, body, count):
    rng = np.random.default_rng(21)
    n = 150
    worlds = alert(
        rng.uniform(5.0, 10.0, (n, vehicles - 1)), rng.uniform(18.0, 22.0, (n, vehicles)),
        braking_capacity_mps2=np.resize([6.0, 7.0, 6.0], vehicles), mass_t=np.resize([4.5, 5.5, 5.9], vehicles),
        latency_s=0.3 * np.arange(vehicles), restitution=0.1,
    )  # fmt: skip
    grid = worlds.car[:, BRAKING, [body]] * np.linspace(0.0, 1.0, 401)
    all_harms = harms(worlds, body, grid, count, 8.0)
    best = coupled(worlds, body, count)
    excess = best.harm - all_harms[0].min(axis=1)
    assert np.quantile(excess, 0.99) <= e_v2x_bm.LEAST_GAIN and excess.mean() <= e_v2x_bm.LEAST_GAIN
    again = harms(worlds, body, best.deceleration_mps2[:, np.newaxis], count, 8.0)[:, :, 0]
    assert (again[0] == best.harm).all()


def test_coupled__of_vehicle_1_is_not_worse_than_a_grid_before_an_obstacle():
    worlds = open_game("cooperation-4-all")[0].sample(40, 7)
    worlds.wanted[:] = -worlds.car[:, BRAKING]
    best, grid = coupled(worlds, 1, "total"), worlds.car[:, BRAKING, [1]] * np.linspace(0.0, 1.0, 401)
    least = harms(worlds, 1, grid, "total", 8.0)[0].min(axis=1)
    assert (best.harm <= least + e_v2x_bm.LEAST_GAIN).all() and best.harm.any() and not best.harm.all()


def test_coupled__decides_ties_by_the_other_count_then_takes_the_middle():
    worlds = open_game("paper-random-obstacle")[0].sample(300, 3)
    worlds.wanted[:, 2] = -worlds.car[:, BRAKING, 2]
    best, ties = coupled(worlds, 2, "first"), 0
    grid = worlds.car[:, BRAKING, [2]] * np.linspace(0.0, 1.0, e_v2x_bm.FIRST_PARTS + 1)
    first, total = harms(worlds, 2, grid, "first", 8.0)
    own = harms(worlds, 2, best.deceleration_mps2[:, np.newaxis], "first", 8.0)[1, :, 0]
    for k in range(worlds.n):
        equal = first[k] <= best.harm[k] + 1e-9
        ties += equal.sum() > 1
        assert not equal.any() or own[k] <= total[k][equal].min() + 1e-8
    assert ties > 20
    known = np.array([np.nan, 1.0, 2.0])
    e_v2x_bm.take_middle(np.arange(5.0), np.array([[1.0, 1.0, 3.0, 1.0, 1.0], [2.0, 4.0, 0.0, 2.0, 2.0]]), known)
    assert known[0] == 3.0  # of 0, 3 and 4


def test_cells__between_steep_ones_are_split() -> None:
    at, harm = np.arange(4.0)[np.newaxis], np.tile([10.0, 4.0, 4.0, 9.0], (2, 1, 1))
    for steep, expected in ((1.0, [0, 1, 2]), (0.0, [])):
        best, cells = np.full((1, 3), np.inf), np.empty((2, 4), np.int64)
        given = harm if steep else np.full_like(harm, 4.0)
        found = e_v2x_bm.find_cells(np.zeros(1, np.int64), at, given, np.ones(1), best, cells)
        assert cells[1, :found].tolist() == expected and best[0, 1] == 4.0


def test_choice__does_not_depend_on_the_batch_nor_on_coasting_before():
    scenario, game = open_game("paper-random")
    worlds = scenario.sample(60, 7)
    worlds.wanted[:, 2] = -worlds.car[:, BRAKING, 2]
    best = coupled(worlds, 2)
    for k in (0, 17, 59):
        assert [column[0] for column in coupled(worlds.take([k]), 2)] == [column[k] for column in best]
    later = first_decision(worlds, game.deciders, game.settings)
    for choose in (coupled, pairwise):
        np.testing.assert_allclose(choose(later, 2).harm, choose(worlds, 2).harm, rtol=0.0, atol=1e-9)


def test_coupled__names_a_world_that_cannot_be_played(monkeypatch):
    worlds = open_game("paper-random")[0].sample(3, 7)
    monkeypatch.setattr(
        e_v2x_bm, "hold", lambda state, wanted, bodies, tried, *_: np.full((2, *tried.shape[:2]), np.inf)
    )
    with pytest.raises(PhysicsError, match="world 0"):
        coupled(worlds, 2)


@pytest.mark.parametrize(
    ("name", "n", "count"),
    [("cooperation-3-pair", 100, "total"), ("paper-random-buildup", 100, "first"), ("stress-wide", 200, "total")],
)
def test_agent__does_the_harm_that_it_predicts_to_the_last_bit(name, n, count):
    scenario, game = open_game(name)
    worlds, agent = scenario.sample(n, 5), make_agent("e_v2x_bm", scenario=scenario, harm_count=count)
    body, *others = scenario.learners
    team = Team("one", {body: agent, **dict.fromkeys(others, make_agent("full_brake"))})
    last = play_to_end(game, worlds, team)
    predicted = last.memories[body].predicted_harm
    assert (predicted == last.harm(count)).all() and predicted.any()
    assert agent.name == "e_v2x_bm" and agent.knows == MODEL
    assert (worlds.wanted[:, scenario.learners] == 0.0).all()  # the alert is as it was


def test_agents__have_the_harm_of_the_readme():
    scenario, game = open_game("paper-random")
    worlds, agent = scenario.sample(10_000, 7), make_agent("e_v2x_bm:pairwise")
    last = play_to_end(game, worlds, Team("pairwise", {2: agent}))
    means = last.harm("first").mean(), last.harm("total").mean(), last.memories[2].predicted_harm.mean()
    assert [f"{mean:.2f}" for mean in means] == ["19.20", "20.68", "9.45"] and agent.knows == STATE


def test_agent__assumes_that_learners_brake_and_scripts_hold_their_command():
    scenario, _ = open_game("paper-random")
    roles = {"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "learner"}
    scenario = scenario.replace(roles=roles)
    worlds = scenario.sample(20, 7)
    memory = make_agent("e_v2x_bm", scenario=scenario).begin(worlds, 2)
    wanted = worlds.wanted.copy()
    assert (wanted[:, 1] == -3.0).all()
    wanted[:, 3] = -worlds.car[:, BRAKING, 3]
    assert (memory.command == -coupled(worlds._replace(wanted=wanted), 2).deceleration_mps2).all()


def test_agents__refuse_vehicles_that_react_and_other_arguments():
    scenario, _ = open_game("paper-random")
    reacting = scenario.replace(early_impacts="keep", roles={**scenario.roles, "vehicle_3": "e_v2x_bm:pairwise"})
    worlds = scenario.sample(2, 7)
    with pytest.raises(
        InvalidInput, match=r"^agent 'e_v2x_bm': vehicle_3 is driven by 'e_v2x_bm:pairwise', whose comm"
    ):
        make_agent("e_v2x_bm", scenario=reacting).begin(worlds, 2)
    assert make_agent("e_v2x_bm", scenario=reacting).begin(worlds, 3).command.shape == (2,)  # the role is its own
    with pytest.raises(InvalidInput, match=r"^agent 'e_v2x_bm:both': must be e_v2x_bm or e_v2x_bm:pairwise$"):
        make_agent("e_v2x_bm:both")
    with pytest.raises(InvalidInput, match="needs a scenario"):
        make_agent("e_v2x_bm")
