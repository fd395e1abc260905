from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.actions import action_to_command
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations, ObservationSpec, observe
from ethbrake_marl.physics import make_worlds
from ethbrake_marl.policies import Policy
from ethbrake_marl.scenario import load_scenario


class _Fixed:
    observation = ObservationSpec()

    def __init__(self, action: list[list[float]]) -> None:
        self._action = np.array(action, np.float32)

    def __call__(self, observation: Observations) -> Observations:
        return self._action


def test_act__is_a_fraction_of_the_own_capacity() -> None:
    worlds = make_worlds(
        [7.0, 7.0],
        np.tile([20.0, 18.0, 20.0], (4, 1)),
        braking_capacity_mps2=[6.0, 8.0, 6.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0],
        latency_s=[0.0, 0.5, 0.8],
        mass_t=5.0,
        restitution=0.1,
    )
    wanted = LearnedAgent(_Fixed([[-1.0], [-0.25], [0.0], [0.5]])).act(worlds, 1)
    assert wanted.dtype == np.float64
    assert wanted.tolist() == [-8.0, -2.0, 0.0, 1.0]


def test_act__does_not_depend_on_the_batch(policy: Policy) -> None:
    worlds = load_scenario("paper-random").sample(200, 7).worlds
    agent = LearnedAgent(policy)
    together = agent.act(worlds, 1)
    assert np.unique(together).size > 100
    for k in (0, 1, 77, 199):
        assert agent.act(worlds.take([k]), 1)[0] == together[k]


def test_act__hands_the_policy_its_own_observation(policy: Policy) -> None:
    worlds = load_scenario("paper-random").sample(5, 7).worlds
    action = policy(observe(worlds, 2, policy.observation))[:, 0].astype(np.float64)
    assert np.array_equal(LearnedAgent(policy).act(worlds, 2), action_to_command(action, worlds.vehicles, 2))


def test_act__refuses_a_policy_with_another_number_of_actions() -> None:
    worlds = load_scenario("paper-random").sample(3, 7).worlds
    with pytest.raises(InvalidInput, match=r"learned: actions of shape \(3, 2\); one per world is needed"):
        LearnedAgent(_Fixed([[0.0, 0.0]] * 3)).act(worlds, 1)
