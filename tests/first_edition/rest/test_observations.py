"""Observations: every feature by name against hand-computed values; forecasts of contact against recorded impacts."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.game.contact_features import FORECAST_S
from ethbrake_marl.first_edition.game.features import GROUPS
from ethbrake_marl.first_edition.game.observations import ObservationSpec, choose_observation, observe
from tests.first_edition.physics.random_worlds import line

near = pytest.approx
SPEC = ObservationSpec(front=2, rear=1)


# ---------------------------------------------------------------- contact features


SCENARIO = eb.load_scenario("paper-random")
STEP_S = 0.1
CONTACT = choose_observation(["contact"], STEP_S)


def seen_by(worlds, vehicle, spec=CONTACT):
    """The features of one vehicle by name, before scaling, [n] each."""
    values = observe(worlds, vehicle, spec)
    return {f.name.removeprefix("contact."): values[:, c] * f.scale for c, f in enumerate(spec.features)}


LINE = {"braking_capacity_mps2": [6.0, 7.0, 6.0], "driving_capacity_mps2": 3.0, "latency_s": 0.0, "restitution": 0.1}


def expected(worlds, vehicle, own_mps2, others_mps2, step_s=STEP_S):
    """The same of one forecast, from the impacts that ``advance`` records."""
    command = others_mps2.copy()
    command[:, vehicle] = own_mps2
    impacts = eb.advance(worlds, command, duration_s=FORECAST_S, record=True)[1]
    rows = impacts.rows
    told = {
        "first_impact_harm": impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm,
        "total_harm": impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm,
    }
    for side, pair in (("front", vehicle - 1), ("rear", vehicle)):
        world, first = np.unique(rows.world[rows.pair == pair], return_index=True)
        time, closing, met = np.full(worlds.n, FORECAST_S), np.zeros(worlds.n), np.isin(np.arange(worlds.n), world)
        time[world] = rows.time_s[rows.pair == pair][first] - worlds.time_s[world]
        closing[world] = rows.closing_speed_mps[rows.pair == pair][first]
        whole = np.maximum(np.ceil(time / step_s) - 1, 0)
        fraction = np.where(met, time / step_s - whole, 0.0)
        parts = {"time": time, "closing_speed": closing, "fraction": fraction, "steps": whole}
        told |= {f"{side}_{name}": values for name, values in parts.items()}
    return told


def check(worlds, vehicle, others_mps2, step_s=STEP_S):
    spec = choose_observation(["contact"], step_s)
    seen, v = seen_by(worlds, vehicle, spec), worlds.vehicles
    own = {"brake": -v.braking_capacity_mps2[:, vehicle], "coast": 0.0, "drive": v.driving_capacity_mps2[:, vehicle]}
    bounds = {f.name.removeprefix("contact."): (f.low * f.scale, f.high * f.scale) for f in spec.features}
    for command, own_mps2 in own.items():
        for name, wanted in expected(worlds, vehicle, own_mps2, others_mps2, step_s).items():
            full = f"{command}_{name}"
            np.testing.assert_allclose(seen[full], np.clip(wanted, *bounds[full]), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("until_s", [0.8, 1.3, 2.1])
def test_contact__is_what_advance_records(until_s):
    start = SCENARIO.sample(60, 3).worlds
    v = start.vehicles
    command = np.column_stack([-v.braking_capacity_mps2[:, 0], np.full(60, -4.0), -v.braking_capacity_mps2[:, 2]])
    worlds, _ = eb.advance(start, command, until_s=until_s)
    assert worlds.pair_hit.any() == (until_s > 1.0)  # a pair that has met may meet again
    check(worlds, 1, command)
    check(worlds, 1, command, step_s=0.04)


def test_contact__sees_the_obstacle_and_vehicle_1_meets_it_in_front():
    start = eb.load_scenario("cooperation-4-all").sample(40, 5).worlds
    others = -start.vehicles.braking_capacity_mps2
    worlds, _ = eb.advance(start, others, until_s=1.0)
    for vehicle in (0, 1):
        check(worlds, vehicle, others)
    near = line([8.0, 40.0], [20.0, 18.0, 15.0], obstacle_gap_m=20.0, **LINE)
    front = seen_by(near, 0)
    assert front["brake_front_time"][0] == pytest.approx((20 - math.sqrt(400 - 240)) / 6, rel=1e-5)
    assert front["brake_front_closing_speed"][0] == pytest.approx(math.sqrt(160.0), rel=1e-5)


def test_contact__hides_whom_no_news_has_come_from_whatever_they_do():
    scenario = SCENARIO.replace(v2x="blocked", horizon_s=20, early_impacts="keep")
    worlds = eb.advance(scenario.sample(300, 1).worlds, np.zeros((300, 3)), until_s=0.6)[0]
    news = worlds.vehicles.known_from_s[:, 1] <= 0.6
    seen = seen_by(worlds, 1)
    assert news[:, 0].any() and not news[:, 0].all() and not news[:, 2].all()
    assert ((seen["coast_front_time"] > 0.0) == news[:, 0]).all()
    assert ((seen["coast_rear_time"] > 0.0) == news[:, 2]).all()
    alone = ~news[:, 0] & ~news[:, 2]
    assert (seen["drive_total_harm"][alone] == 0.0).all() and alone.any()
    changed = replace(worlds, speeds_mps=worlds.speeds_mps.copy())
    changed.speeds_mps[~news[:, 2], 2] = 39.0
    assert observe(changed, 1, CONTACT)[~news[:, 2]].tobytes() == observe(worlds, 1, CONTACT)[~news[:, 2]].tobytes()


def seen(worlds, vehicle, spec, *parts):
    values = zip(spec.features, observe(worlds, vehicle, spec)[0].tolist(), strict=True)
    return {f.name: round(value, 5) for f, value in values if not parts or f.name.startswith(parts)}


FOUR = eb.make_worlds(
    [[8.0, 6.0, 10.0]],
    [[20.0, 18.0, 22.0, 10.0]],
    braking_capacity_mps2=[6.0, 7.0, 5.0, 8.0],
    driving_capacity_mps2=[1.0, 2.0, 3.0, 4.0],
    latency_s=[0.0, 0.5, 0.25, 1.0],
    mass_t=[4.5, 5.5, 5.9, 7.0],
    restitution=0.1,
)
AFTER, TWO_AHEAD = eb.advance(FOUR, [-6.0, 0.0, -5.0, 0.0], until_s=0.5)[0], eb.ObservationSpec(front=2, rear=1)


def test_features__of_vehicle_3_by_hand() -> None:
    # Vehicle 3 after 0.5 s, by hand: Vehicle 1 has braked, Vehicle 3 since 0.25 s; speeds are divided by 20 (closing
    # speeds, like gaps and accelerations, by 10). Nothing that the rear one does lets it touch, so its fitting
    # deceleration is cut.
    v1, v2, v3, v4 = 17.0, 18.0, 22.0 - 1.25, 10.0
    x1, x3 = 20 * 0.5 - 6 * 0.125, 22 * 0.5 - 5 * 0.25**2 / 2
    gap1, gap2, gap3 = 8 + x1 - 9, 6 + 9 - x3, 10 + x3 - 5
    own, front, rear = v3**2 / 10, v1**2 / 12, v4 * 0.5 + v4**2 / 16
    told = seen(AFTER, 2, TWO_AHEAD)
    gaps = (gap2, gap1 + gap2, gap3)
    assert [told[f"{place}.gap"] for place in ("front_1", "front_2", "rear_1")] == [
        round(each / 10, 5) for each in gaps
    ]
    closing = (v3 - v2, v3 - v1, v4 - v3)
    for place, each in zip(("front_1", "front_2", "rear_1"), closing, strict=True):
        assert told[f"{place}.closing_speed"] == round(each / 10, 5)
    assert told["front_2.stopping_margin"] == round((gap1 + gap2 + front - own) / 10, 5)
    assert told["rear_1.stopping_margin"] == round((gap3 + own - rear) / 10, 5)
    assert told["front_2.fitting_deceleration"] == round(v3**2 / (2 * (gap1 + gap2 + front)) / 10, 5)
    assert list(told.items()) == [
        ("own.speed", 1.0375),
        ("own.acceleration", -0.5),
        ("own.braking_capacity", 0.5),
        ("own.driving_capacity", 0.3),
        ("own.mass", 0.59),
        ("own.latency_left", 0.0),
        ("own.restitution", 0.1),
        ("front_1.known", 1.0),
        ("front_1.gap", 0.41563),
        ("front_1.closing_speed", 0.275),
        ("front_1.acceleration", 0.0),
        ("front_1.braking_capacity", 0.7),
        ("front_1.mass", 0.55),
        ("front_1.latency_left", 0.0),
        ("front_1.hit", 0.0),
        ("front_1.stopping_margin", -1.57571),
        ("front_1.fitting_deceleration", 0.7886),
        ("front_2.known", 1.0),
        ("front_2.gap", 1.24063),
        ("front_2.closing_speed", 0.375),
        ("front_2.acceleration", -0.6),
        ("front_2.braking_capacity", 0.6),
        ("front_2.mass", 0.45),
        ("front_2.latency_left", 0.0),
        ("front_2.hit", 0.0),
        ("front_2.stopping_margin", -0.65667),
        ("front_2.fitting_deceleration", 0.58998),
        ("rear_1.known", 1.0),
        ("rear_1.gap", 1.58438),
        ("rear_1.closing_speed", -1.075),
        ("rear_1.acceleration", 0.0),
        ("rear_1.braking_capacity", 0.8),
        ("rear_1.mass", 0.7),
        ("rear_1.latency_left", 0.5),
        ("rear_1.hit", 0.0),
        ("rear_1.stopping_margin", 4.765),
        ("rear_1.fitting_deceleration", 2.0),
    ]
    assert len(told) == TWO_AHEAD.size


def test_features__of_what_is_not_known_or_not_there_are_zero() -> None:
    # What is not known, or not there, reads zero: of Vehicle 4, which may not act yet, and of nobody ahead of Vehicle
    # 1.
    assert {value for name, value in seen(AFTER, 3, TWO_AHEAD).items() if not name.startswith("own.")} == {0.0}
    assert set(seen(AFTER, 0, TWO_AHEAD, "front_").values()) == {0.0}
    assert seen(AFTER, 0, TWO_AHEAD, "rear_1.known") == {"rear_1.known": 1.0}


def test_flag_of_an_impact__belongs_to_the_pair_on_that_side() -> None:
    struck, _ = eb.advance(AFTER, [-6.0, 0.0, -5.0, 0.0], until_s=2.0)
    assert struck.pair_hit.tolist() == [[True, False, False]]
    assert [
        {name: value for name, value in seen(struck, vehicle, TWO_AHEAD).items() if name.endswith(".hit")}
        for vehicle in (1, 2)
    ] == [
        {"front_1.hit": 1.0, "front_2.hit": 0.0, "rear_1.hit": 0.0},
        {"front_1.hit": 0.0, "front_2.hit": 0.0, "rear_1.hit": 0.0},
    ]


def test_place_and_obstacle__by_hand() -> None:
    # At the alert Vehicle 1 has 42 m left, (42 - 400 / 16) m more than it needs, and would fit with 400 / 84 m/s2.
    # All coast for 1 s: Vehicle 3 was 8 + 6 m behind Vehicle 1 and drove 22 m
    # (34 m to the obstacle, 34 - 22^2 / 16 m more than it needs), Vehicle 1 has 22 m left.
    spec = eb.ObservationSpec(0, 0, role=True, obstacle=True)
    start = eb.make_worlds(
        [[8.0, 6.0, 10.0]],
        [[20.0, 18.0, 22.0, 10.0]],
        braking_capacity_mps2=8.0,
        driving_capacity_mps2=1.0,
        latency_s=[0.0, 0.5, 1.0, 1.0],
        mass_t=1.0,
        restitution=0.1,
        obstacle_gap_m=42.0,
    )
    later, struck = (eb.advance(start, 0.0, until_s=time)[0] for time in (1.0, 2.2))
    assert seen(start, 0, spec, "obstacle") == {
        "obstacle.known": 1.0,
        "obstacle.gap": 4.2,
        "obstacle.hit": 0.0,
        "obstacle.stopping_margin": 1.7,
        "obstacle.fitting_deceleration": 0.47619,
    }
    assert set(seen(start, 1, spec, "obstacle").values()) == {0.0}
    assert set(seen(AFTER, 0, spec, "obstacle").values()) == {0.0}
    assert [
        seen(later, vehicle, spec, "role", "obstacle.gap", "obstacle.hit", "obstacle.stopping_margin")
        for vehicle in range(4)
    ] == [
        {
            "role.vehicles_ahead": 0.0,
            "role.vehicles_behind": 2.0,
            "obstacle.gap": 2.2,
            "obstacle.hit": 0.0,
            "obstacle.stopping_margin": -0.3,
        },
        {
            "role.vehicles_ahead": 1.0,
            "role.vehicles_behind": 2.0,
            "obstacle.gap": 3.2,
            "obstacle.hit": 0.0,
            "obstacle.stopping_margin": 1.175,
        },
        {
            "role.vehicles_ahead": 2.0,
            "role.vehicles_behind": 1.0,
            "obstacle.gap": 3.4,
            "obstacle.hit": 0.0,
            "obstacle.stopping_margin": 0.375,
        },
        {
            "role.vehicles_ahead": 2.0,
            "role.vehicles_behind": 0.0,
            "obstacle.gap": 5.6,
            "obstacle.hit": 0.0,
            "obstacle.stopping_margin": 4.975,
        },
    ]
    assert seen(struck, 3, spec, "obstacle.hit") == {"obstacle.hit": 1.0}


@pytest.mark.parametrize(
    ("speed", "expected"),
    [
        (0.0, {"front_1.fitting_deceleration": 0.0}),
        (0.1, {"front_1.fitting_deceleration": 0.5}),
        (0.2, {"front_1.fitting_deceleration": 2.0}),
        (20.0, {"front_1.fitting_deceleration": 2.0}),
    ],
)
def test_fitting_deceleration__without_room_is_that_of_one_millimetre(speed, expected) -> None:
    # Without room the fitting deceleration is that of one millimetre: v^2 / (2 * 0.001 m), divided by 10 and cut at
    # 2.
    touching = line([0.0], [0.0, speed], latency_s=0.0)
    assert seen(touching, 1, eb.ObservationSpec(1, 0), "front_1.fitting") == expected


def test_forecast_of_contact__by_hand() -> None:
    # A forecast of contact: the middle one coasts behind one that brakes at 4 m/s2: 2 t + 2 t^2 = 3 m, closing at
    # sqrt(4 + 2 * 4 * 3); if it brakes there is none, and the time is cut.
    contact = eb.choose_observation(["contact"], 0.1)
    usual = {"driving_capacity_mps2": 3.0, "latency_s": 0.0, "restitution": 0.1}
    worlds = line([3.0, 30.0], [20.0, 22.0, 20.0], **usual, braking_capacity_mps2=[4.0, 7.0, 6.0])
    worlds = eb.advance(worlds, [-4.0, 0.0, -6.0], duration_s=0.0)[0]
    time_s = (-2.0 + math.sqrt(4.0 + 2 * 4.0 * 3.0)) / 4.0
    told = {
        f.name.removeprefix("contact."): float(v) * f.scale
        for f, v in zip(contact.features, observe(worlds, 1, contact)[0], strict=True)
    }
    coast = [told[f"coast_{name}"] for name in ("front_time", "front_closing_speed", "front_fraction", "front_steps")]
    assert coast == near([time_s, math.sqrt(28.0), time_s / 0.1 - 8, 8], abs=1e-4)
    assert told["coast_first_impact_harm"] == near(28.0)
    brake = [told[f"brake_{name}"] for name in ("front_time", "front_closing_speed", "front_fraction", "front_steps")]
    assert brake == [4.0, 0.0, 0.0, 20.0] and told["brake_first_impact_harm"] == 0.0


def test_build_up_times__by_hand() -> None:
    # Brakes that build up at 10 m/s3, and are released at 20: 0.7 s and 0.35 s of the own 7 m/s2. The one behind has
    # brakes that act at once; of the one in front nothing is known before 0.5 s.
    rates = eb.choose_observation(
        ["own_build_up_time", "own_release_time", "front_1.build_up_time", "rear_1.release_time"]
    )
    slow = line(
        [9.0, 30.0],
        [20.0, 20.0, 20.0],
        latency_s=[0.0, 0.5, 0.8],
        braking_capacity_mps2=[4.0, 7.0, 6.0],
        brake_rate_mps3=[8.0, 10.0, math.inf],
        release_rate_mps3=[4.0, 20.0, math.inf],
    )
    assert observe(slow, 1, rates)[0].round(4).tolist() == np.float32([0.7, 0.35, 0.0, 0.0]).tolist()
    later = eb.advance(slow, [-4.0, 0.0, -6.0], until_s=0.5)[0]
    assert observe(later, 1, rates)[0].round(4).tolist() == np.float32([0.7, 0.35, 0.5, 0.0]).tolist()


def test_contact__others_go_on_as_they_are_seen_and_brake_fully_where_nothing_is_seen() -> None:
    command = np.tile([-3.0, 0.0, -2.0], (40, 1))
    early, _ = eb.advance(SCENARIO.sample(40, 3).worlds, command, until_s=0.5)
    assert (early.command_mps2[:, 2] == 0.0).all()  # its latency of 0.8 s has not elapsed
    check(early, 1, np.column_stack([command[:, :2], -early.vehicles.braking_capacity_mps2[:, 2]]))
    check(eb.advance(early, command, until_s=1.0)[0], 1, command)


def test_contact__at_the_alert_shows_nobody_behind_a_latency() -> None:
    before = line([7.0, 7.0], [20.0, 18.0, 20.0], **{**LINE, "latency_s": [0.0, 0.5, 0.8]})
    first, middle, last = (seen_by(before, vehicle) for vehicle in range(3))
    assert not any(values.any() for each in (middle, last) for values in each.values())
    assert (first["brake_front_time"] == 0.0).all()
    assert (first["brake_rear_time"] > 0.0).all()


def test_contact__of_some_commands_only_is_the_same() -> None:
    worlds = eb.advance(SCENARIO.sample(20, 3).worlds, np.zeros((20, 3)), until_s=0.8)[0]
    some = ["contact.brake_rear_fraction", "own.speed", "contact.drive_total_harm"]
    whole = dict(zip([f.name for f in CONTACT.features], observe(worlds, 1, CONTACT).T, strict=True))
    picked = observe(worlds, 1, choose_observation(some, STEP_S))
    assert picked[:, 0].tobytes() == whole[some[0]].tobytes()
    assert picked[:, 2].tobytes() == whole[some[2]].tobytes()


def test_contact__leaves_other_features_alone_in_every_interface() -> None:
    groups = ["own", "front_1", "rear_1", "contact"]
    declared = SCENARIO.replace(observation=groups)
    assert eb.observation_for(declared) == ObservationSpec(contact=True, time_step_s=0.1)
    seen, wider, listed = (
        eb.make_sb3_vec_env(scenario, 6, seed=3, **options).reset()
        for scenario, options in ((SCENARIO, {}), (declared, {}), (SCENARIO, {"observation": groups}))
    )
    assert wider.shape == (6, 27 + len(GROUPS.contact))
    assert wider[:, :27].tobytes() == seen.tobytes()
    parallel = eb.parallel_env(scenario=declared).reset(seed=3)[0]["vehicle_2"]
    assert parallel.tobytes() == wider[0].tobytes()
    assert listed.tobytes() == wider.tobytes()


def test_observe__is_clipped_to_the_stated_bounds() -> None:
    far = eb.make_worlds([1e6], [1.0, 1e4], braking_capacity_mps2=100.0, driving_capacity_mps2=100.0, latency_s=0.0,
                      mass_t=1e5, restitution=1.0, speed_limit_mps=1e5)  # fmt: skip
    seen = observe(far, 1, SPEC)[0]
    low, high = (np.array([getattr(f, side) for f in SPEC.features], np.float32) for side in ("low", "high"))
    assert (seen >= low).all()
    assert (seen <= high).all()
    assert (seen == high).sum() >= 5


def test_place_and_obstacle__are_observed_only_where_there_is_one() -> None:
    plain, spec = (
        eb.observation_for(eb.load_scenario("paper-random")),
        eb.observation_for(eb.load_scenario("cooperation-4-all")),
    )
    assert plain == eb.ObservationSpec() == eb.ObservationSpec(1, 1)
    assert spec == eb.ObservationSpec(1, 1, role=True, obstacle=True)
    assert [feature.name for feature in spec.features[: plain.size]] == [feature.name for feature in plain.features]
    assert [feature.name for feature in spec.features[plain.size :]] == [
        "role.vehicles_ahead",
        "role.vehicles_behind",
        "obstacle.known",
        "obstacle.gap",
        "obstacle.hit",
        "obstacle.stopping_margin",
        "obstacle.fitting_deceleration",
    ]
    assert spec.size == 34
    assert len({feature.name for feature in spec.features}) == 34
