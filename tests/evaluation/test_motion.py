from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import Team, drive, make_agent
from ethbrake_marl.evaluation import Evaluation, record_episode
from ethbrake_marl.evaluation.episodes import EpisodeMotion, follow_episodes, state_at
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import ShieldedDriver


def at(motion: EpisodeMotion, time_s: float) -> Floats:
    """Place of Vehicle 1, gaps, speeds, accelerations at a time."""
    k = max(int(np.searchsorted(motion.pieces[:, 0], time_s, side="right")) - 1, 0)
    return state_at(motion.pieces[k], time_s, motion.world.N)


def test_motion__one_impact_by_hand(pair: Scenario) -> None:
    (motion,) = follow_episodes(pair.sample(1, 0).worlds, make_agent("full_brake"), pair)
    impact = 0.5 + 0.25 / 3.0  # see PAIR
    assert motion.pieces[:3, 0].tolist() == pytest.approx([0.0, 0.5, impact])
    assert motion.pieces[2, 3:5].tolist() == pytest.approx([18.315 - 1.815, 18.015 - 1.815], abs=2.0)
    assert at(motion, impact)[1] == pytest.approx(0.0, abs=1e-12)
    assert motion.impacts.closing_speed_mps.tolist() == pytest.approx([3.0])
    assert motion.harm == pytest.approx((9.0, 9.0))
    assert motion.at_rest and motion.stepped_in_s.size == 0


@pytest.mark.parametrize("spec", ["full_brake", "constant:4.5", "ppo@shipped"])
def test_motion__is_exact_at_every_moment(paper_random: Scenario, spec: str) -> None:
    worlds = paper_random.sample(3, 7).worlds
    agent = make_agent(spec, scenario=paper_random)
    for k, motion in enumerate(follow_episodes(worlds, agent, paper_random)):
        record = record_episode(worlds.take([k]), agent, scenario=paper_random)
        for row, time in enumerate(record.time_s):
            found = at(motion, float(time))
            np.testing.assert_allclose(found[0], record.positions_m[row, 0], atol=1e-9)
            np.testing.assert_allclose(found[1:3], record.gaps_m[row], atol=1e-9)
            np.testing.assert_allclose(found[3:6], record.speeds_mps[row], atol=1e-9)


def test_motion__counts_what_the_evaluation_counts(evaluation: Evaluation) -> None:
    some = evaluation.worlds.take(np.arange(60))
    motions = follow_episodes(some, make_agent("constant:4.5"), evaluation.scenario)
    outcome = evaluation.outcome("constant:4.5")
    for k, motion in enumerate(motions):
        assert motion.harm == (outcome.first_impact_harm[k], outcome.total_harm[k])
        assert len(motion.impacts.time_s) == outcome.impacts[k]
        assert motion.end_s == outcome.final.time_s[k]


def test_motion__tells_where_a_shield_stepped_in(paper_random: Scenario) -> None:
    worlds = paper_random.sample(4, 7).worlds
    for spec in ("constant:3+step", "constant:3+episode"):
        motions = follow_episodes(worlds, make_agent(spec, scenario=paper_random), paper_random)
        assert any(motion.stepped_in_s.size for motion in motions)
        assert all((motion.stepped_in_s >= 0.5).all() for motion in motions)  # Vehicle 2 acts from then on


def test_motion__tells_where_the_shield_of_a_team_stepped_in_as_its_log_does() -> None:
    scenario = load_scenario("cooperation-3-pair")
    worlds = scenario.sample(6, 7).worlds
    team = ShieldedDriver(Team.of(make_agent("constant:3"), (1, 2)), scenario, logging=True).on((1, 2))
    log = drive(worlds, team, scenario).guarded.shield.log
    motions = follow_episodes(worlds, make_agent("constant:3+step", scenario=scenario), scenario)
    for k, motion in enumerate(motions):
        times = sorted({entry.time_s for entry in log if entry.world == k})
        np.testing.assert_allclose(motion.stepped_in_s, times)
    assert sum(motion.stepped_in_s.size for motion in motions) > 10


def test_motion__of_a_line_with_an_obstacle_ends_where_the_record_does() -> None:
    scenario = load_scenario("paper-random-obstacle")
    worlds = scenario.sample(3, 7).worlds
    agent = make_agent("full_brake")
    for k, motion in enumerate(follow_episodes(worlds, agent, scenario)):
        record = record_episode(worlds.take([k]), agent, scenario=scenario)
        np.testing.assert_allclose(at(motion, motion.end_s)[0], record.positions_m[-1, 0], atol=1e-9)
        assert motion.impacts.pair.min(initial=0) == record.impacts.pair.min(initial=0)


def test_motion__cascade_of_bounces_stays_small_and_ends_right(pair: Scenario) -> None:
    bouncy = pair.replace(restitution=0.9)
    (motion,) = follow_episodes(bouncy.sample(1, 0).worlds, make_agent("coast"), bouncy)
    assert len(motion.impacts.time_s) > 10
    np.testing.assert_allclose(at(motion, motion.end_s)[1], motion.final.gaps_m[0, 0], atol=1e-6)
    assert (np.diff(motion.pieces[:, 0]) > 0.0).all()
