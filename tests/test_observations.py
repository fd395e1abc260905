"""Observations: every feature by name against hand-computed values; forecasts of contact against recorded impacts."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import observations
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.observations import FORECAST_S, ObservationSpec, choose_observation, observe
from tests.fixtures.policies import make_policy
from tests.physics.random_worlds import line

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


def test_contact__where_brakes_build_up_is_the_same_for_who_trains_and_who_is_asked():
    roles = {"vehicle_1": "constant:2", "vehicle_2": "learner", "vehicle_3": "coast"}
    scenario = SCENARIO.replace(brake_rate_mps3=12.65, release_rate_mps3=12.65, roles=roles)
    env = eb.EthBrakeEnv(scenario, observation=CONTACT)
    env.reset(seed=1)
    for _ in range(3):
        seen = env.step(np.array([-0.3], np.float32))[0]
        assert seen.tobytes() == observe(env.engine.worlds, 1, CONTACT)[0].tobytes()


@pytest.mark.parametrize("group", ["contact", "contact_far"])
def test_policy__observes_contacts_at_the_steps_of_its_training(group):
    spec = choose_observation(["own", group])
    policy = make_policy(spec, SCENARIO.replace(time_step_s=0.05).model_dump(mode="json"))
    assert policy.observation == choose_observation(["own", group], 0.05)
    outcome = eb.evaluate(SCENARIO.sample(5, 7), {"mine": eb.LearnedAgent(policy)}, scenario=SCENARIO).outcome("mine")
    assert np.isfinite(outcome.total_harm).all()
    assert choose_observation(["own"], 0.1).time_step_s is None  # nothing that depends on it


def test_contact__failed_forecast_names_its_world(monkeypatch):
    def fail(*arguments):
        arguments[-1][1] = True

    monkeypatch.setattr(observations, "_observe_contacts", fail)
    worlds = SCENARIO.sample(3, 1).worlds
    with pytest.raises(PhysicsError, match="world 1: a forecast of contacts could not look 10 s ahead"):
        observe(worlds, 1, CONTACT)


def test_contact_far__tells_what_the_others_cut_off():
    """The times up to 10 s, and the square roots of the harms, of the same forecasts; the others stay as they are."""
    wide = eb.load_scenario("stress-wide").sample(300, 3).worlds
    worlds = eb.advance(wide, np.zeros((300, 3)), until_s=0.4)[0]
    both = choose_observation(["own", "contact", "contact_far"], STEP_S)
    seen = dict(zip([f.name for f in both.features], observe(worlds, 1, both).T, strict=True))
    alone = observe(worlds, 1, choose_observation(["contact_far"], STEP_S))
    assert alone.shape == (300, 12) and alone.tobytes() == observe(worlds, 1, both)[:, -12:].tobytes()
    for name, values in zip([f.name for f in CONTACT.features], observe(worlds, 1, CONTACT).T, strict=True):
        assert values.tobytes() == seen[name].tobytes()
    hard = 0
    for command in ("brake", "coast", "drive"):
        for time in ("front_time", "rear_time"):
            found, cut = seen[f"contact_far.{command}_{time}"] * 5.0, seen[f"contact.{command}_{time}"] * 2.0
            np.testing.assert_allclose(np.minimum(found, 4.0), cut, rtol=1e-6)
            assert (found <= 10.0).all()
        for far, near in (("first_impact_speed", "first_impact_harm"), ("total_speed", "total_harm")):
            found, cut = (seen[f"contact_far.{command}_{far}"] * 10.0) ** 2, seen[f"contact.{command}_{near}"] * 50.0
            np.testing.assert_allclose(np.minimum(found, 200.0), cut, rtol=1e-5, atol=1e-4)
            hard += int((found > 200.0).sum())
    assert hard > 30
