"""Rollout classification: costs, loss and memory by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.extensions.learners.model import Visited
from tests.extensions.learners.tiny import PAPER, ROLLOUTS, new_model


@pytest.mark.parametrize(("objective", "learners"), [("total", ["vehicle_2"]), ("own", ["vehicle_2", "vehicle_3"])])
def test_costs__are_those_of_the_moved_learner_in_episodes_driven_so(objective: str, learners: list[str]) -> None:
    """Full braking of all but for what is tried: each action for its steps, then the policy, to the end."""
    line, rows = PAPER.with_learners(learners).replace(objective=objective), 8 * len(learners)
    settings = {"near": [], "fixed": [1.0], "drawn": 1, "holds": [3], "network": {"policy": [8], "choices": 5}}
    model = new_model(ROLLOUTS.replace(**settings, tried=rows, caution=0.0), line)
    start, seen, each = model.rows.episode.take(np.arange(8)), model._last_obs, np.arange(rows)
    torch.manual_seed(5)
    found, tried, costs = model.try_choices(Visited(model.lines[0], seen, start))
    assert sorted(found) == [*range(rows)] and (tried[:, :2] == [0, 4]).all() and len(set(tried[:, 2])) > 1
    world, moved = np.divmod(found, len(learners))
    for way in range(3):
        now = start.take(world)
        for step in range(200):
            action = np.full((rows, len(learners)), -1.0)
            if step < 3:
                action[each, moved] += 0.5 * tried[:, way]
            now, _ = model.lines[0].game.step(now, action)
        harm = amounts(objectives_of(objective, 3), None, now, HarmCount.of("total"))[each, moved + 1]
        np.testing.assert_allclose(costs[:, way], harm, rtol=1e-12, atol=1e-12)
    model.recipe = model.recipe.replace(caution=2.0)  # what goes beyond full braking, here the policy
    model._update_current_progress_remaining(1, 2)  # half of it by now
    torch.manual_seed(5)
    cautious, beyond = model.try_choices(Visited(model.lines[0], seen, start))[2], np.maximum(costs - costs[:, :1], 0.0)
    assert beyond.max() > 0.1
    np.testing.assert_allclose(cautious, costs + beyond, rtol=1e-12, atol=1e-12)


def test_tried_choices__are_its_own_some_near_it_some_fixed_and_some_drawn() -> None:
    ranges = [{"smallest": 0.001, "largest": 0.001}, {"smallest": 0.5, "largest": 0.5}]
    model = new_model(ROLLOUTS.replace(near=ranges, fixed=[-1.0, 0.1], drawn=1, network={"policy": [8], "choices": 9}))
    with torch.no_grad():
        model.policy.average[-1].bias[3] = 1.0  # action -0.25; the next actions are 0.25 apart
    tried = model.choices_at(model._last_obs)
    assert (tried[:, :7] == [3, 2, 4, 1, 5, 0, 4]).all() and len(set(tried[:, 7])) > 1
    np.testing.assert_array_equal(model.policy.act(model._last_obs), np.full(8, np.float32(-0.25)))


def test_loss__by_hand_and_what_is_remembered_last() -> None:
    shape = {"near": [], "fixed": [0.0, 1.0], "drawn": 0, "network": {"policy": [8], "choices": 3}}
    chooser = new_model(ROLLOUTS.replace(tried=2, memory=2, **shape)).policy
    seen, tried = np.zeros((2, 27), np.float32), np.array([[0, 1, 2], [0, 1, 2]])
    costs = np.array([[9.0, 9.0, 9.0], [0.0, 2.0, 4.0]], np.float32)
    chooser.memory.store(seen=seen, tried=tried, more=costs)
    chooser.memory.store(seen=seen[:1], tried=tried[:1], more=costs[1:])
    assert int(chooser.memory.known) == 3 and chooser.memory.more.tolist() == [[0.0, 2.0, 4.0], [0.0, 2.0, 4.0]]
    with torch.no_grad():
        chooser.learning[-1].bias.copy_(torch.log(torch.tensor([1.0, 2.0, 3.0])))
    expected, convex = (2.0 * 2.0 + 4.0 * 3.0) / 6.0, 2.0 * math.log(1.0 + 2.0) + 4.0 * math.log(1.0 + 3.0)
    some = torch.tensor([0, 1, 1])
    assert chooser.loss(some, 0.0).item() == pytest.approx(expected)
    assert chooser.loss(some, 0.1).item() == pytest.approx(expected + 0.1 * convex)
