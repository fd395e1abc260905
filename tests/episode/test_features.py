"""Features: every one by name against numbers computed by hand, what is not known, and what is clipped."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import views_of
from tests.episode.lines import later, state_of

TWO_AHEAD = View(["own", "front_1", "front_2", "rear_1"])


def seen(state: State, body: int, view: View, *parts: str) -> dict[str, float]:
    values = zip(view.features, view.observe(state, np.array([body]), 0.1)[0, 0].tolist(), strict=True)
    return {f.name: round(value, 5) for f, value in values if not parts or f.name.startswith(parts)}


FOUR = state_of(
    [[8.0, 6.0, 10.0]], [[20.0, 18.0, 22.0, 10.0]],
    braking_capacity_mps2=[6.0, 7.0, 5.0, 8.0], driving_capacity_mps2=[1.0, 2.0, 3.0, 4.0],
    latency_s=[0.0, 0.5, 0.25, 1.0], mass_t=[4.5, 5.5, 5.9, 7.0], restitution=0.1,
)  # fmt: skip


@cache
def braked() -> State:
    return later(FOUR, [-6.0, 0.0, -5.0, 0.0], 0.5)


def test_features__of_vehicle_3_by_hand() -> None:
    # Vehicle 1 has braked for 0.5 s, Vehicle 3 for 0.25 s. Speeds are divided by 20; closing speeds, gaps and
    # accelerations by 10. Nothing that the rear one does lets it touch, so its fitting deceleration is cut.
    v1, v2, v3, v4 = 17.0, 18.0, 22.0 - 1.25, 10.0
    x1, x3 = 20 * 0.5 - 6 * 0.125, 22 * 0.5 - 5 * 0.25**2 / 2
    gap1, gap2, gap3 = 8 + x1 - 9, 6 + 9 - x3, 10 + x3 - 5
    own, front, middle, rear = v3**2 / 10, v1**2 / 12, v2**2 / 14, v4 * 0.5 + v4**2 / 16
    expected = {
        "own.speed": v3 / 20, "own.acceleration": -0.5, "own.braking_capacity": 0.5, "own.driving_capacity": 0.3,
        "own.mass": 0.59, "own.latency_left": 0.0, "own.restitution": 0.1,
        "front_1.known": 1.0, "front_1.gap": gap2 / 10, "front_1.closing_speed": (v3 - v2) / 10,
        "front_1.acceleration": 0.0, "front_1.braking_capacity": 0.7, "front_1.mass": 0.55,
        "front_1.latency_left": 0.0, "front_1.hit": 0.0, "front_1.stopping_margin": (gap2 + middle - own) / 10,
        "front_1.fitting_deceleration": v3**2 / (2 * (gap2 + middle)) / 10,
        "front_2.known": 1.0, "front_2.gap": (gap1 + gap2) / 10, "front_2.closing_speed": (v3 - v1) / 10,
        "front_2.acceleration": -0.6, "front_2.braking_capacity": 0.6, "front_2.mass": 0.45,
        "front_2.latency_left": 0.0, "front_2.hit": 0.0, "front_2.stopping_margin": (gap1 + gap2 + front - own) / 10,
        "front_2.fitting_deceleration": v3**2 / (2 * (gap1 + gap2 + front)) / 10,
        "rear_1.known": 1.0, "rear_1.gap": gap3 / 10, "rear_1.closing_speed": (v4 - v3) / 10,
        "rear_1.acceleration": 0.0, "rear_1.braking_capacity": 0.8, "rear_1.mass": 0.7,
        "rear_1.latency_left": 0.5, "rear_1.hit": 0.0, "rear_1.stopping_margin": (gap3 + own - rear) / 10,
        "rear_1.fitting_deceleration": 2.0,
    }  # fmt: skip
    found = seen(braked(), 3, TWO_AHEAD)
    assert [*found] == [*expected] and found == pytest.approx(expected, abs=1e-5)


def test_what_is_not_known_or_not_there__is_zero() -> None:
    # Vehicle 4 may not act yet, and nobody drives ahead of Vehicle 1
    assert {value for name, value in seen(braked(), 4, TWO_AHEAD).items() if not name.startswith("own.")} == {0.0}
    assert set(seen(braked(), 1, TWO_AHEAD, "front_").values()) == {0.0}
    assert seen(braked(), 1, TWO_AHEAD, "rear_1.known") == {"rear_1.known": 1.0}


def test_who_is_unknown__can_do_anything_unseen() -> None:
    scenario = load_scenario("paper-random").replace(v2x="blocked", horizon_s=20, early_impacts="keep")
    state = later(scenario.sample(100, 1), 0.0, 0.6)
    unknown = state.know[:, 2, [1, 3]] > 0.6
    assert unknown.any(axis=0).all() and not unknown.all(axis=0).any()
    line, view = state.line.copy(), View()
    line[:, 0, 1], line[:, 0, 3] = np.where(unknown, 39.0, line[:, 0, [1, 3]]).T
    found, same = (view.observe(each, np.array([2]), 0.1).tobytes() for each in (state, state._replace(line=line)))
    assert found == same
    known = [f"{side}_1.known" for side in ("front", "rear")]
    assert (View(known).observe(state, np.array([2]), 0.1)[:, 0] == ~unknown).all()


def test_hit__belongs_to_the_pair_on_that_side() -> None:
    struck = later(braked(), [-6.0, 0.0, -5.0, 0.0], 2.0)
    assert struck.pair_hit.tolist() == [[True, False, False]]
    hits = [[seen(struck, body, TWO_AHEAD)[f"{side}.hit"] for side in ("front_1", "rear_1")] for body in (1, 2, 3)]
    assert hits == [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]


def test_place_and_obstacle__by_hand() -> None:
    # At the alert Vehicle 1 has 42 m left, (42 - 400 / 16) m more than it needs, and would fit with 400 / 84 m/s2. All
    # coast for 1 s: Vehicle 3 was 8 + 6 m behind Vehicle 1 and drove 22 m (34 m to the obstacle).
    view = View(["role", "obstacle"])
    usual = {"braking_capacity_mps2": 8.0, "latency_s": [0.0, 0.5, 1.0, 1.0]}
    start = state_of([[8.0, 6.0, 10.0]], [[20.0, 18.0, 22.0, 10.0]], obstacle_gap_m=42.0, **usual)
    then, struck = (later(start, 0.0, time) for time in (1.0, 2.2))
    assert seen(start, 1, view, "obstacle") == {
        "obstacle.known": 1.0, "obstacle.gap": 4.2, "obstacle.hit": 0.0, "obstacle.stopping_margin": 1.7,
        "obstacle.fitting_deceleration": round(400 / 84 / 10, 5),
    }  # fmt: skip
    assert set(seen(start, 2, view, "obstacle").values()) == set(seen(braked(), 1, view, "obstacle").values()) == {0.0}
    margin = {1: 22 - 20**2 / 16, 2: 32 - 18**2 / 16, 3: 34 - 22**2 / 16, 4: 56 - 10**2 / 16}
    expected = {1: (0.0, 2.0, 2.2), 2: (1.0, 2.0, 3.2), 3: (2.0, 1.0, 3.4), 4: (2.0, 0.0, 5.6)}
    for body, (ahead, behind, gap) in expected.items():
        found = seen(then, body, view)
        assert (found["role.vehicles_ahead"], found["role.vehicles_behind"]) == (ahead, behind)
        assert (found["obstacle.gap"], found["obstacle.hit"]) == (gap, 0.0)
        assert found["obstacle.stopping_margin"] == pytest.approx(margin[body] / 10, abs=1e-5)
    assert seen(struck, 4, view, "obstacle.hit") == {"obstacle.hit": 1.0}


@pytest.mark.parametrize(("speed", "fitting"), [(0.1, 0.5), (20.0, 2.0)])
def test_fitting_deceleration__without_room_is_that_of_one_millimetre(speed: float, fitting: float) -> None:
    touching = state_of([0.0], [0.0, speed])  # v^2 / (2 * 0.001 m), divided by 10 and cut at 2
    assert seen(touching, 2, View(["front_1.fitting_deceleration"])) == {"front_1.fitting_deceleration": fitting}


def test_brakes_that_build_up__by_hand() -> None:
    # 0.7 s and 0.35 s of the own 7 m/s2; the brakes behind act at once; of the one in front nothing is known at first
    view = View(["own_build_up_time", "own_release_time", "front_1.build_up_time", "rear_1.release_time", "place"])
    slow = state_of(
        [9.0, 30.0], [20.0, 20.0, 20.0], latency_s=[0.0, 0.5, 0.8], braking_capacity_mps2=[4.0, 7.0, 6.0],
        brake_rate_mps3=[8.0, 10.0, math.inf], release_rate_mps3=[4.0, 20.0, math.inf],
    )  # fmt: skip
    assert [*seen(slow, 2, view).values()] == pytest.approx([0.7, 0.35, 0.0, 0.0, 1.0])
    after = later(slow, [-4.0, 0.0, -6.0], 0.5)
    assert [*seen(after, 2, view).values()] == pytest.approx([0.7, 0.35, 0.5, 0.0, 1.0])


def test_what_is_observed__is_clipped_to_its_bounds() -> None:
    far = state_of(
        [1e6], [1.0, 1e4], braking_capacity_mps2=100.0, driving_capacity_mps2=100.0, mass_t=1e5, restitution=1.0,
        speed_limit_mps=1e5,
    )  # fmt: skip
    found = TWO_AHEAD.observe(far, np.array([2]), 0.1)[0, 0]
    low, high = (np.array([getattr(f, side) for f in TWO_AHEAD.features], np.float32) for side in ("low", "high"))
    assert (found >= low).all() and (found <= high).all() and (found == high).sum() >= 5


@pytest.mark.parametrize(
    "listed", [["rear_1", "own_build_up_time", "front_2.hit"], ["front_1.build_up_time", "front_1"]]
)
def test_view__of_some_features_has_the_bits_of_the_whole_in_its_own_order(listed: list[str]) -> None:
    view = View(listed)
    groups = View(["own", "front_1", "front_2", "rear_1", "role", "obstacle", "place", "own_build_up_time",
                   "front_1.build_up_time"])  # fmt: skip
    whole = dict(zip(groups.names, groups.observe(braked(), np.array([3]), 0.1)[0, 0], strict=True))
    assert view.observe(braked(), np.array([3]), 0.1)[0, 0].tolist() == [whole[name] for name in view.names]


def test_views_of_several_bodies__are_theirs_alone() -> None:
    together = TWO_AHEAD.observe(braked(), np.array([3, 1]), 0.1)
    assert together[0, 0].tobytes() == TWO_AHEAD.observe(braked(), np.array([3]), 0.1)[0, 0].tobytes()
    assert together[0, 1].tobytes() == TWO_AHEAD.observe(braked(), np.array([1]), 0.1)[0, 0].tobytes()


def test_role_and_obstacle__are_observed_only_where_there_is_an_obstacle() -> None:
    plain, ahead = (views_of(load_scenario(name))[0] for name in ("paper-random", "cooperation-4-all"))
    assert plain == View() and len(plain.features) == 27 and len(ahead.features) == 34
    assert ahead.names[:27] == plain.names
    assert {name.partition(".")[0] for name in ahead.names[27:]} == {"role", "obstacle"}


@pytest.mark.parametrize(
    ("name", "size", "steps"), [("paper-random", 7 * 3 + 2 * 2 + 1, 1), ("cooperation-4-all", 28, 15)]
)
def test_full_state__has_every_vehicle_pair_time_and_obstacle(name: str, size: int, steps: int) -> None:
    scenario, game = open_game(name)
    state = game.reset(scenario.sample(5, 7))
    for _ in range(steps):
        state, _ = game.step(state, np.full((5, len(game.settings.learners)), -0.5))
    obstacle = scenario.has_obstacle
    features = state_features(scenario.vehicles, scenario.horizon_s, obstacle)
    found: Any = full_state(state, scenario.horizon_s, obstacle)
    columns = {f.name: found[:, k] * f.scale for k, f in enumerate(features)}
    assert found.shape == (5, size) and found.dtype == np.float32
    for i in range(1, 4):
        np.testing.assert_allclose(columns[f"vehicle_{i}.speed"], state.speeds_mps[:, i - 1], rtol=1e-6)
        np.testing.assert_allclose(columns[f"vehicle_{i}.mass"], state.mass_t[:, i - 1], rtol=1e-6)
        left = np.maximum(state.latency_s[:, i - 1] - state.time_s, 0.0)
        np.testing.assert_allclose(columns[f"vehicle_{i}.latency_left"], left, rtol=1e-6, atol=1e-7)
    for p in (1, 2):
        np.testing.assert_allclose(columns[f"pair_{p}.gap"], np.minimum(state.gaps_m[:, p - 1], 100.0), rtol=1e-5)
        assert columns[f"pair_{p}.hit"].tolist() == state.pair_hit[:, p - 1].tolist()
    np.testing.assert_allclose(columns["time"], state.time_s, rtol=1e-6)
    if obstacle:
        np.testing.assert_allclose(columns["obstacle.gap"], np.minimum(state.obstacle_gap_m, 100.0), rtol=1e-5)


@pytest.mark.parametrize(
    ("listed", "text"),
    [
        ([], "must be a list of groups and features"),
        ([1], "1: must be the name of a group or of a feature"),
        (["own", "own.speed"], "own.speed is listed twice"),
        (["build_up_time"], "describes a neighbour; write front_1.build_up_time"),
        (["own.sped"], "did you mean 'own.speed'"),
    ],
)
def test_view__refuses_what_is_no_list_of_features(listed: Any, text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        View(listed)
