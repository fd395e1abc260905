from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import Evaluation, evaluate, record_episode
from ethbrake_marl.scenario import Scenario

IMPACT_S = 0.5 + 0.25 / 3.0  # see PAIR


def test_record__one_impact_by_hand(pair: Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, make_agent("full_brake"), scenario=pair)
    assert record.impacts.first.tolist() == [True]
    np.testing.assert_allclose(record.impacts.time_s, [IMPACT_S], rtol=1e-12)
    np.testing.assert_allclose(record.impacts.closing_speed_mps, [3.0], rtol=1e-12)
    time = record.time_s
    before = time < IMPACT_S
    front = np.where(time <= IMPACT_S, 20.0 * time - 3.0 * time**2, 0.0)
    np.testing.assert_allclose(record.positions_m[before, 0], front[before], atol=1e-11)
    at_impact = 20.0 * IMPACT_S - 3.0 * IMPACT_S**2
    stopped = at_impact + 18.315**2 / 12.0  # braking with 6 m/s2 from the speed after the impact
    np.testing.assert_allclose(record.positions_m[-1], [stopped, stopped - 0.90825], atol=1e-10)
    coasting = time <= 0.5
    np.testing.assert_allclose(record.positions_m[coasting, 1], 20.0 * time[coasting] - 1.0, atol=1e-11)
    np.testing.assert_allclose(record.positions_m[:, 0] - record.positions_m[:, 1], record.gaps_m[:, 0], atol=1e-10)


def test_record__commands_are_in_force_from_the_latency_on(pair: Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, make_agent("constant:4"), scenario=pair)
    waiting = record.time_s < 0.5
    assert (record.command_mps2[waiting, 1] == 0.0).all()
    assert (record.command_mps2[~waiting, 1] == -4.0).all()
    assert (record.command_mps2[:, 0] == -6.0).all()
    assert waiting.any()
    assert 0.5 in record.time_s


def test_record__a_command_stands_at_its_decision_not_one_step_later(pair: Scenario) -> None:
    class Countdown:
        name = "countdown"

        def act(self, worlds: object, vehicle: int) -> np.ndarray:
            return np.where(worlds.time_s < 1.05, -1.0, -5.0)

    record = record_episode(pair.sample(1, 0).worlds, Countdown(), scenario=pair)
    decided = record.time_s > 1.1 - 1e-9
    acting = record.time_s >= 0.5
    assert (record.command_mps2[decided, 1] == -5.0).all()
    assert (record.command_mps2[acting & ~decided, 1] == -1.0).all()


def test_record__agrees_with_the_evaluation_to_the_last_bit(evaluation: Evaluation, gap_agent: object) -> None:
    outcome = evaluation.outcome("gap")
    for k in (0, int(np.argmax(outcome.impacts))):
        record = record_episode(evaluation.worlds.take([k]), gap_agent, scenario=evaluation.scenario)
        np.testing.assert_array_equal(record.ledger.total_harm[0], outcome.ledger.total_harm[k], strict=True)
        np.testing.assert_array_equal(record.gaps_m[-1], outcome.final.gaps_m[k], strict=True)
        np.testing.assert_array_equal(record.speeds_mps[-1], outcome.final.speeds_mps[k], strict=True)
        assert record.time_s[-1] == outcome.final.time_s[k]
        assert len(record.impacts.time_s) == outcome.impacts[k]
        assert np.sum(record.impacts.closing_speed_mps**2) == pytest.approx(outcome.total_harm[k], rel=1e-12)


@pytest.mark.parametrize("sample_s", [0.02, 0.007, 5.0])
def test_record__samples_are_as_fine_as_asked_and_never_change_the_motion(
    evaluation: Evaluation, sample_s: float
) -> None:
    world = evaluation.worlds.take([1])
    agent = make_agent("full_brake")
    record = record_episode(world, agent, scenario=evaluation.scenario, sample_s=sample_s)
    coarse = record_episode(world, agent, scenario=evaluation.scenario)
    assert record.time_s[0] == 0.0
    steps = np.diff(record.time_s)
    assert (steps > 0.0).all()
    assert steps.max() <= min(sample_s, 0.5) + 1e-12
    np.testing.assert_array_equal(record.gaps_m[-1], coarse.gaps_m[-1], strict=True)
    common = np.isin(record.time_s, coarse.time_s)
    assert common.sum() > 30
    shared = np.isin(coarse.time_s, record.time_s)
    np.testing.assert_allclose(record.positions_m[common], coarse.positions_m[shared], atol=1e-10)


def test_record__an_impact_at_the_very_alert_is_there(pair: Scenario) -> None:
    at_once = pair.replace(latency_s=[0.0, 0.0])
    world = at_once.worlds_from_state({"gaps_m": [0.0], "speeds_mps": [18.0, 20.0]})
    record = record_episode(world, make_agent("full_brake"), scenario=at_once)
    assert record.impacts.time_s[0] == 0.0
    assert record.impacts.closing_speed_mps[0] == 2.0
    assert record.time_s[0] == 0.0
    assert (np.diff(record.time_s) > 0.0).all()
    assert len(record.impacts.time_s) == record.ledger.count.sum()


def test_record__bad_input_is_refused(evaluation: Evaluation) -> None:
    agent, scenario = make_agent("full_brake"), evaluation.scenario
    with pytest.raises(InvalidInput, match="2 worlds given"):
        record_episode(evaluation.worlds.take([0, 1]), agent, scenario=scenario)
    for sample_s in (0.0, -0.1, float("nan"), float("inf")):
        with pytest.raises(InvalidInput, match="sample_s"):
            record_episode(evaluation.worlds.take([0]), agent, scenario=scenario, sample_s=sample_s)


def test_record__a_vehicle_pushed_above_its_speed_limit_goes_on() -> None:
    scenario = Scenario(
        name="pushed", vehicles=2, gaps_m=5, speeds_mps=[20, 25], braking_capacity_mps2=6, driving_capacity_mps2=3,
        mass_t=[1.5, 10], latency_s=[0, 0.5], speed_limit_mps=[20, 30], time_step_s=1.0,
        roles={"vehicle_1": "coast", "vehicle_2": "learner"},
    )  # fmt: skip
    worlds, agent = scenario.sample(1, 0).worlds, make_agent("coast")
    final = evaluate(worlds, {"coast": agent}, scenario=scenario).outcome("coast").final
    record = record_episode(worlds, agent, scenario=scenario)
    assert (record.speeds_mps[-1] > 24.0).all()  # momentum: 280/11.5 = 24.35 m/s in the mean
    np.testing.assert_array_equal(record.speeds_mps[-1], final.speeds_mps[0], strict=True)
    np.testing.assert_array_equal(record.gaps_m[-1], final.gaps_m[0], strict=True)
    # Struck at 1 s by 5 m/s, e = 0.1.
    np.testing.assert_allclose(record.positions_m[-1, 0], 20.0 + 7.0 * (20.0 + 1.1 * 5.0 * 10.0 / 11.5), rtol=1e-12)
