"""Vine on lines of different vehicles and learners, and a network that begins as a policy and as a feature."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import CallbackList

import ethbrake_marl as eb
from ethbrake_marl.extensions.learners.actor import start_weights
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.training.train import resume, train
from tests.extensions.learners.tiny import PAPER, VINE, new_model
from tests.fixtures.commands import Command, told_json
from tests.refused import refused
from tests.training.tiny import dying_after, kept, killed

FIVE = eb.load_scenario("cooperation-2-five").with_learners(["vehicle_3", "vehicle_4"])
MEMBERS = [{"scenario": PAPER.declared(), "weight": 3}, {"scenario": FIVE.declared()}]
LINES = eb.load_scenario({"name": "lines", "mixture": MEMBERS})
SEEN = ["own", "front_1", "rear_1", "role"]
MIXING = VINE.replace(observation=SEEN, reward={"harm": 1.0, "harm_count": "honest"}, gradient_limit=0.5, anchor=0.1)


def test_update__joins_the_decisions_of_all_lines_and_divides_their_returns() -> None:
    model = new_model(MIXING.replace(gradient_limit=1e9), LINES)
    assert [(line.environment.n, line.learners, line.tried) for line in model.lines] == [(6, 1, 12), (2, 2, 4)]
    callback = CallbackList([])
    callback.init_callback(model)
    model.ep_info_buffer, model.ep_success_buffer = [], []
    visited = model.collect(callback)
    assert [len(part.observations) for part in visited] == [4 * 6, 4 * 2 * 2]
    assert [part.states.vehicles for part in visited] == [3, 5] and model.num_timesteps == 4 * 10
    for part, scenario, bodies in zip(visited, (PAPER, FIVE), ([2], [3, 4]), strict=True):
        _, game = eb.open_game(scenario, observation=SEEN)
        seen = np.stack(game.observe(part.states, np.array(bodies)), axis=1)
        np.testing.assert_array_equal(part.observations, seen.reshape(part.observations.shape))
    for part in visited:
        torch.manual_seed(5)
        relative = model.try_out(part).gradient
        torch.manual_seed(5)
        absolute = model.try_out(part._replace(line=part.line._replace(cost=1.0))).gradient
        assert part.line.cost > 10.0 and absolute.any()
        torch.testing.assert_close(relative, absolute / part.line.cost)
    lesson: list[Any] = []
    model.train_actor = lesson.append
    model.improve(visited)
    assert len(lesson[0].seen) == len(lesson[0].gradient) == 12 + 4


def test_cost__of_each_line_is_what_full_braking_costs_in_its_part_of_the_list() -> None:
    costs = [line.cost for line in new_model(MIXING, LINES).lines]
    parts = ((PAPER, 8), (FIVE, 2))  # of the 10 worlds of the fixed list, by the weights 3 and 1
    right = [
        eb.evaluate(scenario, "full_brake", episodes=n, harm_count="honest")["full_brake"]["honest_cost"].mean()
        for scenario, n in parts
    ]
    assert costs == pytest.approx(right) and costs[0] != pytest.approx(costs[1])


def begin(run: Path, **settings: Any) -> Any:
    return train(MIXING.replace(total_steps=6 * 40), LINES, run, **{"on_progress": None, **settings})


def test_training__resumed_after_a_kill_is_the_same(tmp_path: Path) -> None:
    result = begin(tmp_path / "whole")
    assert result.policy.manifest.learners == ("vehicle_2", "vehicle_3", "vehicle_4")
    assert result.policy.manifest.training_range is not None
    assert {"objective", "relative_paper-random", "relative_cooperation-2-five"} <= result.metrics.keys()
    killed(begin, tmp_path / "run", on_progress=dying_after(3))
    assert resume(tmp_path / "run", on_progress=None).status == "finished"
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")
    for scenario in ("paper-random", FIVE):  # one policy for both
        assert eb.evaluate(scenario, result.agent, episodes=3)[result.agent]["honest_cost"].shape == (3,)


@pytest.mark.slow
def test_training__gets_better_in_every_line(tmp_path: Path) -> None:
    ample = MIXING.replace(
        n_envs=256, n_steps=8, tried=256, batch_size=32, network={"policy": [32]}, total_steps=30 * 8 * 320,
        evaluation={"every_updates": 1000, "worlds": 400, "seed": 7},
    )  # fmt: skip
    first, last = train(ample, LINES, tmp_path / "run", on_progress=None).evaluations
    for name in ("relative_paper-random", "relative_cooperation-2-five"):
        assert last[name] < 0.7 * first[name]


def test_command__shows_costs_relative_to_full_braking(ethbrake: Command, empty_folder: Path) -> None:
    Path("lines.yaml").write_text(json.dumps(LINES.declared()))
    Path("mixing.yaml").write_text(json.dumps(MIXING.replace(name="mixing", total_steps=40).model_dump(mode="json")))
    answer = told_json(
        ethbrake("train", "--recipe", "mixing.yaml", "--scenario", "lines.yaml", "--output", "run", "--json")
    )
    braking, trained = answer["fixed_list"]["results"]
    assert braking["objective"] == pytest.approx(1.0) and trained["objective"] != braking["objective"]
    assert answer["next_command"] == "ethbrake evaluate --scenario paper-random --agents full_brake,team@run"


def test_network__begins_as_a_policy_in_its_range_and_as_a_feature_elsewhere() -> None:
    policy, random = load_shipped("ppo"), np.random.default_rng(0)
    features = ["plan.action", *reversed(policy.observation.names), "own.extra"]
    sizes = [len(features), 128 + 2 + 2 * 27 + 3, 128 + 3 + 2, 4 + 1, 1]
    names = ["policy.0", "policy.1", "policy.2", "policy.output"]
    network = {
        f"{name}.{part}": random.normal(size=(after, before) if part == "weight" else after).astype(np.float32)
        for name, before, after in zip(names, sizes[:-1], sizes[1:], strict=True)
        for part in ("weight", "bias")
    }
    recipe = VINE.replace(name="mine", network={"policy": [8], "initial_action": "plan.action"})
    tensors = start_weights(policy, network, features, recipe)
    known = policy.manifest.training_range
    assert known is not None
    inside = random.uniform(known.low, known.high, (200, 27)).astype(np.float32)
    outside = inside.copy()
    outside[np.arange(200), np.arange(200) % 27] += np.where(np.arange(200) % 2, 3.0, -9.0)
    plan = random.uniform(-1, 0, 200).astype(np.float32)

    def output(observed: Any) -> Any:
        layer = np.column_stack([plan, observed[:, ::-1], random.normal(size=200)])
        for name in names:
            layer = layer @ tensors[f"{name}.weight"].T + tensors[f"{name}.bias"]
            layer = layer if name == "policy.output" else np.maximum(layer, 0.0)
        return np.clip(layer[:, 0], -1.0, 1.0)

    np.testing.assert_allclose(output(inside), policy(inside)[:, 0], atol=1e-4)
    np.testing.assert_allclose(output(outside), plan, atol=1e-4)
    assert np.abs(policy(outside)[:, 0] - plan).max() > 0.1
    for name in names[:-1]:  # units that are not needed keep their weights
        np.testing.assert_array_equal(tensors[f"{name}.weight"][-1], network[f"{name}.weight"][-1])
    small = {**network, "policy.2.bias": np.zeros(3, np.float32)}
    with refused("recipe 'mine': network.policy must have 3 layers with at least 184, 131, 4 units, to begin as"):
        start_weights(policy, small, features, recipe)
    with refused("recipe 'mine': start: must name a relu policy whose bundle has the range of its training"):
        start_weights(policy.with_range(None), network, features, recipe)
    with refused("recipe 'mine': the observation lacks the features own.speed"):
        start_weights(policy, network, ["plan.action"], recipe)


def test_training__starts_from_a_policy_and_a_feature(tmp_path: Path) -> None:
    still = MIXING.replace(
        start="ppo", observation=["own", "front_1", "rear_1", "role", "obstacle", "plan"], total_steps=1,
        network={"policy": [190, 135, 8], "initial_action": "plan.action"},
        learning_rate={"start": 1e-12, "end": 1e-12},
    )  # fmt: skip
    policy = train(still, LINES, tmp_path / "run", measure=None, on_progress=None).policy
    agents = {"ppo": "ppo", "plan": "plan", "policy": eb.LearnedAgent(policy)}
    home = eb.evaluate("paper-random", agents, episodes=200)
    same = np.isclose(home["policy"]["honest_cost"], home["ppo"]["honest_cost"], atol=1e-2)
    assert same.mean() > 0.8  # the range leaves out a thousandth of each feature's values at each end
    away = eb.evaluate("realistic-truck", agents, episodes=200)
    np.testing.assert_allclose(away["policy"]["honest_cost"], away["plan"]["honest_cost"], atol=1e-3)
