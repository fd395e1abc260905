"""Single episodes: recorded, and as exact motion."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.motion import EpisodeMotion, follow_episodes, state_at
from ethbrake_marl.first_edition.evaluation.record import record_episode
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver

IMPACT_S = 0.5 + 0.25 / 3.0  # see PAIR
BRAKE = make_agent("full_brake")

# ---------------------------------------------------------------- records


def test_record__one_impact_by_hand(pair: eb.Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, BRAKE, scenario=pair)
    impacts, time = record.impacts, record.time_s
    assert (impacts.first.tolist(), [*impacts.time_s], [*impacts.closing_speed_mps]) == (
        [True], pytest.approx([IMPACT_S]), pytest.approx([3.0]),
    )  # fmt: skip
    before, coasting = time < IMPACT_S, time <= 0.5
    np.testing.assert_allclose(record.positions_m[before, 0], (20.0 * time - 3.0 * time**2)[before], atol=1e-11)
    np.testing.assert_allclose(record.positions_m[coasting, 1], 20.0 * time[coasting] - 1.0, atol=1e-11)
    # braking with 6 m/s2 from the speed after the impact
    stopped = 20.0 * IMPACT_S - 3.0 * IMPACT_S**2 + 18.315**2 / 12.0
    np.testing.assert_allclose(record.positions_m[-1], [stopped, stopped - 0.90825], atol=1e-10)
    np.testing.assert_allclose(record.positions_m[:, 0] - record.positions_m[:, 1], record.gaps_m[:, 0], atol=1e-10)


class Countdown:
    name = "countdown"

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        return np.where(worlds.time_s < 1.05, -1.0, -5.0)


def test_record__a_command_is_in_force_from_the_latency_and_its_decision_on(pair: eb.Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, Countdown(), scenario=pair)
    expected = np.select([record.time_s < 0.5, record.time_s < 1.1 - 1e-9], [0.0, -1.0], -5.0)
    assert record.command_mps2[:, 1].tolist() == expected.tolist() and set(expected) == {0.0, -1.0, -5.0}
    assert (record.command_mps2[:, 0] == -6.0).all() and 0.5 in record.time_s


def test_record__agrees_with_the_evaluation_to_the_last_bit(evaluation: Evaluation, gap_agent: Any) -> None:
    outcome = evaluation.outcome("gap")
    for k in (0, int(np.argmax(outcome.impacts))):
        record = record_episode(evaluation.worlds.take([k]), gap_agent, scenario=evaluation.scenario)
        ends = [record.ledger.total_harm[0], record.gaps_m[-1], record.speeds_mps[-1], record.time_s[-1]]
        final = outcome.final
        expected = [outcome.ledger.total_harm[k], final.gaps_m[k], final.speeds_mps[k], final.time_s[k]]
        assert [np.asarray(each).tolist() for each in ends] == [np.asarray(each).tolist() for each in expected]
        assert len(record.impacts.time_s) == outcome.impacts[k]
        assert np.sum(record.impacts.closing_speed_mps**2) == pytest.approx(outcome.total_harm[k], rel=1e-12)


@pytest.mark.parametrize("sample_s", [0.02, 0.007, 5.0])
def test_record__samples_are_as_fine_as_asked_and_never_change_the_motion(
    evaluation: Evaluation, sample_s: float
) -> None:
    world, scenario = evaluation.worlds.take([1]), evaluation.scenario
    record = record_episode(world, BRAKE, scenario=scenario, sample_s=sample_s)
    coarse = record_episode(world, BRAKE, scenario=scenario)
    steps = np.diff(record.time_s)
    assert record.time_s[0] == 0.0 < steps.min() and steps.max() <= min(sample_s, 0.5) + 1e-12
    np.testing.assert_array_equal(record.gaps_m[-1], coarse.gaps_m[-1], strict=True)
    common, shared = np.isin(record.time_s, coarse.time_s), np.isin(coarse.time_s, record.time_s)
    assert common.sum() > 30
    np.testing.assert_allclose(record.positions_m[common], coarse.positions_m[shared], atol=1e-10)


def test_record__an_impact_at_the_very_alert_is_there(pair: eb.Scenario) -> None:
    at_once = pair.replace(latency_s=[0.0, 0.0])
    world = worlds_from_state(at_once, {"gaps_m": [0.0], "speeds_mps": [18.0, 20.0]})
    record = record_episode(world, BRAKE, scenario=at_once)
    assert (record.impacts.time_s[0], record.impacts.closing_speed_mps[0], record.time_s[0]) == (0.0, 2.0, 0.0)
    assert (np.diff(record.time_s) > 0.0).all() and len(record.impacts.time_s) == record.ledger.count.sum()


# ---------------------------------------------------------------- motion


def at(motion: EpisodeMotion, time_s: float) -> Floats:
    """Place of Vehicle 1, gaps, speeds, accelerations at a time."""
    k = max(int(np.searchsorted(motion.pieces[:, 0], time_s, side="right")) - 1, 0)
    return state_at(motion.pieces[k], time_s, motion.world.N)


@pytest.mark.parametrize(
    ("name", "spec"),
    [("paper-random", "constant:4.5"), ("paper-random", "ppo"), ("paper-random-obstacle", "full_brake"),
     ("pair", "full_brake")],
)  # fmt: skip
def test_motion__is_exact_at_every_moment(name: str, spec: str, pair: eb.Scenario) -> None:
    scenario = pair if name == "pair" else eb.load_scenario(name)
    worlds, agent = scenario.sample(3, 7).worlds, make_agent(spec, scenario=scenario)
    for k, motion in enumerate(follow_episodes(worlds, agent, scenario)):
        record, N = record_episode(worlds.take([k]), agent, scenario=scenario), worlds.N
        found = np.array([at(motion, float(time))[: 2 * N] for time in record.time_s])
        recorded = np.column_stack([record.positions_m[:, 0], record.gaps_m, record.speeds_mps])
        np.testing.assert_allclose(found, recorded, atol=1e-9)
        assert motion.impacts.pair.tolist() == record.impacts.pair.tolist()
        assert motion.at_rest and motion.stepped_in_s.size == 0


def test_motion__tells_where_the_shield_of_a_team_stepped_in_as_its_log_does() -> None:
    scenario = eb.load_scenario("cooperation-3-pair")
    worlds = scenario.sample(6, 7).worlds
    team = ShieldedDriver(Team.of(make_agent("constant:3"), (1, 2)), scenario, logging=True).on((1, 2))
    log = drive(worlds, team, scenario).guarded.shield.log
    motions = follow_episodes(worlds, make_agent("constant:3+step", scenario=scenario), scenario)
    told = [sorted({entry.time_s for entry in log if entry.world == k}) for k in range(6)]
    np.testing.assert_allclose(np.concatenate([each.stepped_in_s for each in motions]), np.concatenate(told))
    assert list(map(len, told)) == [each.stepped_in_s.size for each in motions] and sum(map(len, told)) > 10


def test_motion__cascade_of_bounces_stays_small_and_ends_right(pair: eb.Scenario) -> None:
    bouncy = pair.replace(restitution=0.9)
    (motion,) = follow_episodes(bouncy.sample(1, 0).worlds, make_agent("coast"), bouncy)
    assert len(motion.impacts.time_s) > 10 and (np.diff(motion.pieces[:, 0]) > 0.0).all()
    np.testing.assert_allclose(at(motion, motion.end_s)[1], motion.final.gaps_m[0, 0], atol=1e-6)


def test_record__a_vehicle_pushed_above_its_speed_limit_goes_on() -> None:
    scenario = eb.Scenario(
        name="pushed", vehicles=2, gaps_m=5, speeds_mps=[20, 25], braking_capacity_mps2=6, driving_capacity_mps2=3,
        mass_t=[1.5, 10], latency_s=[0, 0.5], speed_limit_mps=[20, 30], time_step_s=1.0,
        roles={"vehicle_1": "coast", "vehicle_2": "learner"},
    )  # fmt: skip
    record = record_episode(scenario.sample(1, 0).worlds, make_agent("coast"), scenario=scenario)
    assert (record.speeds_mps[-1] > 24.0).all()  # momentum: 280/11.5 = 24.35 m/s in the mean
    # Struck at 1 s by 5 m/s, e = 0.1.
    np.testing.assert_allclose(record.positions_m[-1, 0], 20.0 + 7.0 * (20.0 + 1.1 * 5.0 * 10.0 / 11.5), rtol=1e-12)
