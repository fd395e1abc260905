"""Worlds that cannot be advanced: every layer names them by the rows of its own batch, and the others go on."""

import numpy as np
import pytest

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.engine.stream import FailedWorld
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.certify import Backup, certify
from ethbrake_marl.first_edition.shields.running import begin_running
from ethbrake_marl.first_edition.shields.step import StepShield
from tests.first_edition.rest.failing_worlds import planted_list

PAPER = load_scenario("paper-random")
N, PLANTED = 9, [2, 6]


@pytest.fixture
def worlds():
    return planted_list(PAPER, N, 7, PLANTED).worlds


def failed_rows(call):
    with pytest.raises(PhysicsError) as raised:
        call()
    return sorted(raised.value.worlds)


def braking(worlds):
    return -worlds.vehicles.braking_capacity_mps2


def test_every_search_and_forecast__names_all_of_them(worlds):
    candidates = np.tile([-6.0, 0.0], (N, 1))
    for call in (
        lambda: advance(worlds, braking(worlds), until_s=8.0, threads=3),
        lambda: advance(worlds, braking(worlds), until_s=8.0, record=True),
        lambda: forecast(worlds, braking(worlds), 1, candidates, 8.0),
        lambda: optimise_coupled(worlds, 1),
        lambda: profile_problem(worlds, [1]),
        lambda: StepShield(PAPER, 1).begin(worlds, np.arange(N)),
    ):
        assert failed_rows(call) == PLANTED


def engine(n=3, seed=5):
    return make_engine(PAPER, n, seed=seed)


def break_row(running, k):
    """Put row k into a state that the next step cannot leave."""
    state, column = running.packed.state, running.packed.column
    state[k, column.gap : column.hit] = [0.5, -1.0]
    state[k, column.speed : column.command] = [10.0, 20.0, 16.0]


def test_engine__cuts_the_episode_off_names_the_world_and_steps_the_others():
    running, twin = engine(), engine()
    running.step(np.zeros((3, 1)))
    twin.step(np.zeros((3, 1)))
    break_row(running, 1)
    before = running.packed.state[1].copy()
    with pytest.warns(FailedWorld, match=r"^world 1 of seed 5: a contact was missed between 0.6 s and 0.7 s"):
        step = running.step(np.full((3, 1), -0.5))
    expected = twin.step(np.full((3, 1), -0.5))
    assert step.truncated.tolist() == (step.failed > 0).tolist() == running.ended.tolist() == [False, True, False]
    assert not step.terminated.any() and list(running.roster.failed) == [1] and not step.reward[1].any()
    assert np.array_equal(running.packed.state[[0, 2]], twin.packed.state[[0, 2]])
    assert np.array_equal(step.reward[[0, 2]], expected.reward[[0, 2]])
    kept = [0, *range(running.packed.column.gap, before.size)]  # time, gaps, flags, harm
    assert np.array_equal(running.packed.state[1, kept], before[kept])
    running.renew(np.array([1]))  # the next world of the stream
    assert running.roster.failed == {} and not running.ended.any()
    break_row(running, 1)
    with pytest.warns(FailedWorld, match=r"^world 3 of seed 5"):
        running.step(np.zeros((3, 1)))


def test_shield__a_proposal_that_cannot_be_advanced_is_not_certified():
    running = begin_running(profile_problem(PAPER.sample(3, 7).worlds, [1]))
    plan = np.full((3, 81), -1.0)
    states = running.states.copy()
    states[1, :5] = [10.0, 20.0, 16.0, 0.5, -1.0]
    broken = running._replace(states=states)
    harm = np.full(3, 1e3)  # the plan cannot be followed there either; the others are well
    assert failed_rows(lambda: certify(broken, np.zeros(3), Backup(plan, harm), harm)) == [1]
