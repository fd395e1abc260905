"""Forecasts of contact against the impacts that happen, and what is assumed of the others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.forecasts.contacts import FORECAST_S
from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import EVENT_BY_EVENT
from ethbrake_marl.policies.bundle import load_shipped, shipped_policies
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.episode.lines import later, state_of
from tests.motion.lines import driven

CONTACT = View(["contact"])
PAPER = load_scenario("paper-random")


def seen(state: State, body: int, step_s: float = 0.1, view: View = CONTACT) -> dict[str, np.ndarray]:
    values = view.observe(state, np.array([body]), step_s)[:, 0]
    return {f.name.partition(".")[2]: values[:, c] * f.scale for c, f in enumerate(view.features)}


def happens(state: State, body: int, own: Any, others: Any, step_s: float) -> dict[str, np.ndarray]:
    """The same features, from the impacts of lines that follow these commands for the time of a forecast."""
    commands = np.array(others, float, copy=True)
    commands[:, body - 1] = own
    before = state.line.copy()
    before[:, [at.FIRST, at.TOTAL]] = 0.0
    line, met, rows = driven(before, state.car, commands, state.time_s, state.time_s + FORECAST_S)
    told = {"first_impact_harm": line[:, at.FIRST].sum(axis=1), "total_harm": line[:, at.TOTAL].sum(axis=1)}
    for side, pair in (("front", body - 1), ("rear", body)):
        time = np.where(met == EVENT_BY_EVENT, rows[:, at.NEXT_TIME, pair], math.inf)
        hit = time < math.inf
        time = np.where(hit, time, FORECAST_S)
        steps = np.maximum(np.ceil(time / step_s) - 1, 0)
        told[f"{side}_time"], told[f"{side}_steps"] = time, steps
        told[f"{side}_closing_speed"] = np.where(hit, rows[:, at.NEXT_CLOSING, pair], 0.0)
        told[f"{side}_fraction"] = np.where(hit, time / step_s - steps, 0.0)
    return told


def check(state: State, body: int, others: Any, step_s: float = 0.1) -> None:
    found = seen(state, body, step_s)
    bounds = {f.name.partition(".")[2]: (f.low * f.scale, f.high * f.scale) for f in CONTACT.features}
    own = {"brake": -state.car[:, at.BRAKING, body], "coast": 0.0, "drive": state.car[:, at.DRIVING, body]}
    for command, mps2 in own.items():
        for name, expected in happens(state, body, mps2, others, step_s).items():
            full = f"{command}_{name}"
            np.testing.assert_allclose(found[full], np.clip(expected, *bounds[full]), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("until_s", [0.8, 1.3, 2.1])
def test_forecast__is_what_happens(until_s: float) -> None:
    start = PAPER.sample(60, 3)
    commands = np.column_stack([-start.car[:, at.BRAKING, 1], np.full(60, -4.0), -start.car[:, at.BRAKING, 3]])
    state = later(start, commands, until_s)
    assert state.pair_hit.any() == (until_s > 1.0)  # a pair that has met may meet again
    check(state, 2, commands)
    check(state, 2, commands, step_s=0.04)


def test_others__go_on_as_they_are_seen_and_brake_fully_where_nothing_is_seen() -> None:
    commands = np.tile([-3.0, 0.0, -2.0], (40, 1))
    early = later(PAPER.sample(40, 3), commands, 0.5)
    assert (early.forces_mps2[:, 2] == 0.0).all()  # its latency of 0.8 s has not elapsed
    check(early, 2, np.column_stack([commands[:, :2], -early.car[:, at.BRAKING, 3]]))
    check(later(early, commands, 1.0), 2, commands)


def test_obstacle__is_met_by_vehicle_1_in_front() -> None:
    start = load_scenario("cooperation-4-all").sample(40, 5)
    commands = -start.car[:, at.BRAKING, 1:]
    state = later(start, commands, 1.0)
    for body in (1, 2):
        check(state, body, commands)
    near = state_of([8.0, 40.0], [20.0, 18.0, 15.0], obstacle_gap_m=20.0, braking_capacity_mps2=6.0)
    front = seen(near, 1)
    assert front["brake_front_time"][0] == pytest.approx((20 - math.sqrt(400 - 240)) / 6, rel=1e-5)
    assert front["brake_front_closing_speed"][0] == pytest.approx(math.sqrt(160.0), rel=1e-5)


def test_forecast__by_hand() -> None:
    # The middle one coasts behind one that brakes at 4 m/s2: 2 t + 2 t^2 = 3 m, closing at sqrt(4 + 2 * 4 * 3); if it
    # brakes there is no impact, and the time is cut.
    usual = {"driving_capacity_mps2": 3.0, "restitution": 0.1, "braking_capacity_mps2": [4.0, 7.0, 6.0]}
    state = later(state_of([3.0, 30.0], [20.0, 22.0, 20.0], **usual), [-4.0, 0.0, -6.0], 1e-9)
    found, time_s = {name: float(value[0]) for name, value in seen(state, 2).items()}, (math.sqrt(28.0) - 2.0) / 4.0
    parts = ("front_time", "front_closing_speed", "front_fraction", "front_steps")
    assert [found[f"coast_{part}"] for part in parts] == pytest.approx(
        [time_s, math.sqrt(28.0), time_s / 0.1 - 8, 8], abs=1e-4
    )
    assert found["coast_first_impact_harm"] == pytest.approx(28.0, abs=1e-4)
    assert [found[f"brake_{part}"] for part in parts] == [4.0, 0.0, 0.0, 20.0]
    assert found["brake_first_impact_harm"] == 0.0


def test_who_is_not_known__is_not_forecast_whatever_it_does() -> None:
    scenario = PAPER.replace(v2x="blocked", horizon_s=20, early_impacts="keep")
    state = later(scenario.sample(300, 1), 0.0, 0.6)
    known = state.know[:, 2] <= 0.6
    found = seen(state, 2)
    assert known[:, 1].any() and not known[:, 1].all() and not known[:, 3].all()
    assert ((found["coast_front_time"] > 0.0) == known[:, 1]).all()
    assert ((found["coast_rear_time"] > 0.0) == known[:, 3]).all()
    alone = ~known[:, 1] & ~known[:, 3]
    assert alone.any() and not found["drive_total_harm"][alone].any()
    line = state.line.copy()
    line[~known[:, 3], at.SPEED, 3] = 39.0
    bits = [CONTACT.observe(s, np.array([2]), 0.1)[~known[:, 3]].tobytes() for s in (state, state._replace(line=line))]
    assert bits[0] == bits[1]


def test_policies_that_observe_forecasts__have_a_range() -> None:
    assert shipped_policies().keys() == {"ppo", "sac", "vine-paper"}
    assert load_shipped("vine-paper").manifest.training_range is not None
