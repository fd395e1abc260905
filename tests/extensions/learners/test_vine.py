"""Vine: targets by hand, policies to start from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.extensions.learners.actor import Actor, widen
from ethbrake_marl.extensions.learners.vine import TrialResults, Visited, trusted_targets
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.train import train
from tests.extensions.learners.tiny import PAIR, VINE, new_model
from tests.refused import refused

SMALL = {name: getattr(VINE, name) for name in ("n_envs", "n_steps", "tried", "batch_size", "evaluation")}
STILL = load_recipe("vine").replace(**SMALL, learning_rate={"start": 1e-12, "end": 1e-12}, total_steps=1)


def test_targets__keep_the_slope_and_stay_within_the_radius_and_the_bounds() -> None:
    # r = 0.05 and k = 3: g = 0.15 moves by 0.15 / (3 + 3), g = 1e6 by almost 0.05, g = 0 not at all
    gradient = torch.tensor([0.0, 0.15, -0.15, 1e6, 1e6, 0.15, -1e6, -0.15, -1e6])
    mean = torch.tensor([0.3, 0.0, 0.0, 0.0, 1.0, -2.0, -2.0, 2.0, -1.0])
    target, weight = trusted_targets(TrialResults(torch.zeros(9, 1), mean, gradient), 0.05, 3.0)
    assert [round(float(each), 6) for each in target] == [0.3, 0.025, -0.025, 0.05, 1.0, -1.975, -2.0, 1.975, -1.0]
    assert [round(float(each), 5) for each in weight[[0, 1, 2, 4]]] == [3.0, 6.0, 6.0, 3.0]
    assert [round(float(each), 5) for each in (weight * (target - mean))[:3]] == [0.0, 0.15, -0.15]


@pytest.mark.parametrize("limit", [0.01, 1e9])
def test_measured_gradients__are_those_of_the_return_up_to_their_limit(limit: float) -> None:
    """Two learners with their own objectives: the difference between two whole episodes, played by hand."""
    small = {"smallest": 1e-4, "largest": 2e-4}  # within it the cost has no jump
    recipe = VINE.replace(
        gradient_limit=limit, holds=[2], tried=32, offset=small, reward={"harm": 1.0, "objective": "own"}
    )
    model = new_model(recipe, PAIR)
    states, seen = model.rows.episode.take(np.arange(8)), model._last_obs
    tried = model.try_out(Visited(seen, states))
    gradients = tried.gradient.numpy()
    assert len(tried.seen) == 16 and np.abs(gradients).max() > (0.1 if limit > 1.0 else 0.0)
    assert np.abs(gradients).max() <= np.float32(limit)
    row = int(np.abs(gradients).argmax())
    (place,) = np.flatnonzero((seen == tried.seen[row].numpy()).all(axis=1))
    game, gained = model.rows.game, []
    for offset in (1e-4, -1e-4):
        now, total = states.take([place // 2]), 0.0
        for number in range(200):
            rows = game.observe_alike(now, game.settings.learners)[0]
            actions = model.policy.act(rows).astype(np.float64)
            actions[place % 2] += offset if number < 2 else 0.0
            now, step = game.step(now, actions[np.newaxis])
            total += step.reward[0, 1 + place % 2]
            if now.ended[0]:
                break
        gained.append(total)
    slope = (gained[0] - gained[1]) / 4e-4
    assert gradients[row] == pytest.approx(np.clip(slope, -limit, limit), rel=0.1)
    cut = model.logger.name_to_value["train/gradient_cut"]
    assert cut == 0.0 if limit > 1.0 else cut > 0.5


def test_simulated_decisions__are_those_of_all_learners_in_all_branches() -> None:
    model = new_model(VINE, PAIR)
    act, asked = model.policy.act, []
    model.policy.act = lambda rows: asked.append(len(rows)) or act(rows)
    for _ in range(2):
        asked.clear()
        results = model.try_out(Visited(model._last_obs, model.rows.episode))
        assert model.simulated == sum(asked) > 4 * len(results.seen)
        model.train_actor(results)
        assert model.logger.name_to_value["train/simulated"] == sum(asked) and model.simulated == 0


def test_training__starts_from_a_policy_and_drives_as_it_did(tmp_path: Path) -> None:
    policy = train(STILL, "paper-random", tmp_path / "run", measure=None, on_progress=None).policy
    agents = {"old": eb.LearnedAgent(eb.load_shipped("ppo")), "new": eb.LearnedAgent(policy)}
    found = eb.evaluate("paper-random", agents, episodes=50)
    np.testing.assert_allclose(found["old"]["total_harm"], found["new"]["total_harm"], atol=1e-3)
    assert (policy.manifest.algorithm, len(policy.manifest.observation.features)) == ("vine", 57)
    assert eb.make_agent(f"vine@{tmp_path / 'run'}").name == f"vine@{tmp_path / 'run'}"


def test_first_action__is_given_by_one_key() -> None:
    with refused("network.initial_action = -0.5: must be left out beside the key start, whose policy gives the first"):
        VINE.replace(start="ppo", network={"policy": [8], "initial_action": -0.5})


def test_first_action__is_a_number_and_nearly_what_the_network_does() -> None:
    recipe = VINE.replace(network={"policy": [8, 6], "initial_action": -0.9})
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    means = Actor(["own.speed", "own.force", "own.mass"], recipe).means(observations)
    assert means == pytest.approx(np.full(50, -0.9), abs=0.1) and len(set(means)) == 50
    with refused("network.initial_action = plan.action: must be a number"):
        VINE.replace(network={"policy": [8], "initial_action": "plan.action"})


def test_start__needs_the_layers_and_the_features_of_its_policy() -> None:
    with refused("recipe 'vine': network.policy_hidden is (8,), but must be (128, 128), as in the policy that the key"):
        new_model(VINE.replace(start="ppo"))
    with refused("recipe 'vine': the observation lacks the features front_1.known"):
        new_model(STILL.replace(observation=["own", "rear_1"]))


def test_wider_policy__keeps_the_weights_of_its_features_in_their_new_places() -> None:
    policy = load_shipped("ppo")
    first = widen(policy, ["contact.brake_total_harm", *reversed(policy.observation.names)])["policy.0.weight"]
    assert not first[:, 0].any()
    np.testing.assert_array_equal(first[:, 1:], policy.tensors["policy.0.weight"][:, ::-1])
