"""Rollout classification: costs, loss and memory by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.worlds.sampling import member_numbers
from tests.extensions.learners.tiny import MIXTURE, PAPER, ROLLOUTS, new_model


@pytest.mark.parametrize(("objective", "learners"), [("total", ["vehicle_2"]), ("own", ["vehicle_2", "vehicle_3"])])
def test_costs__are_those_of_the_moved_learner_in_episodes_driven_so(objective: str, learners: list[str]) -> None:
    """Full braking of all but for what is tried: each action for its steps, then the policy, to the end."""
    line, rows = PAPER.with_learners(learners).replace(objective=objective), 8 * len(learners)
    settings = {"near": [], "fixed": [1.0], "drawn": 1, "holds": [3], "network": {"policy": [8], "choices": 5}}
    model = new_model(ROLLOUTS.replace(**settings, tried=rows, caution=0.0), line)
    start, seen, each = model.rows.episode.take(np.arange(8)), model._last_obs, np.arange(rows)
    torch.manual_seed(5)
    found, tried, costs = model.try_choices(seen, start)
    assert sorted(found) == [*range(rows)] and (tried[:, :2] == [0, 4]).all() and len(set(tried[:, 2])) > 1
    world, moved = np.divmod(found, len(learners))
    for way in range(3):
        now = start.take(world)
        for step in range(200):
            action = np.full((rows, len(learners)), -1.0)
            if step < 3:
                action[each, moved] += 0.5 * tried[:, way]
            now, _ = model.game.step(now, action)
        harm = amounts(objectives_of(objective, 3), None, now, "total")[each, moved + 1]
        np.testing.assert_allclose(costs[:, way], harm, rtol=1e-12, atol=1e-12)
    model.recipe = model.recipe.replace(caution=2.0)  # what goes beyond full braking, here the policy
    model._update_current_progress_remaining(1, 2)  # half of it by now
    torch.manual_seed(5)
    cautious, beyond = model.try_choices(seen, start)[2], np.maximum(costs - costs[:, :1], 0.0)
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
    (drawn,) = chooser.draw(1, 4, 0.0)
    assert chooser.loss(*drawn, 0.0).item() == pytest.approx(expected)
    assert chooser.loss(*drawn, 0.1).item() == pytest.approx(expected + 0.1 * convex)
    chooser.memory.more[0] = (
        0.0  # nothing to lose: hardly drawn any more, but what is drawn counts as before on average
    )
    batches = [*chooser.draw(50, 40, 0.8)]
    rows, importance = (torch.cat(each) for each in zip(*batches, strict=True))
    assert [len(some) for some, _ in batches] == [40] * 50 and float((rows == 1).float().mean()) > 0.85
    assert [float(importance[rows == row].sum()) / 1000 for row in (0, 1)] == pytest.approx([1.0, 1.0], abs=0.2)


def test_policies__drive_as_alone_and_costs_are_beside_those_usual_in_each_scenario() -> None:
    settings = {"policies": ["ppo", "sac"], "near": [], "fixed": [-1.0], "drawn": 2, "holds": [1000], "caution": 0.0}
    model = new_model(ROLLOUTS.replace(**settings, tried=8, network={"policy": [8], "choices": 2}), MIXTURE)
    start, seen = model.rows.episode.take(np.arange(8)), model._last_obs
    torch.manual_seed(5)
    found, tried, costs = model.try_choices(seen, start)
    assert (tried[:, 0] == 0).all() and (tried[:, 1] == 2).all() and (np.sort(tried[:, 2:]) == [0, 1]).all()
    alone = [eb.load_shipped("ppo"), eb.load_shipped("sac"), lambda now: np.full((len(now), 1), -1.0)]
    for number, act in enumerate(alone):
        now = start.take(found)
        for _ in range(200):
            now, _ = model.game.step(now, act(model.game.observe_alike(now, [2])[:, 0]).astype(np.float64))
        column = costs[tried == number].reshape(8, -1)
        np.testing.assert_allclose(column.T, np.tile(now.harm("total"), (column.shape[1], 1)), rtol=1e-3, atol=1e-4)
    model.recipe = model.recipe.replace(relative=True, tie_break=0.5)
    torch.manual_seed(5)
    least, usual = model.try_choices(seen, start)[2].min(axis=1), model.policy.usual.numpy().copy()
    assert (usual > 0.0).all() and usual[0] < usual[1]
    member = member_numbers(MIXTURE, np.arange(8), 0, "training")[found]
    assert [least[member == m].mean() for m in range(2)] == pytest.approx([1.0, 1.0])  # the first mean is the usual one
    torch.manual_seed(5)
    model.recipe = model.recipe.replace(relative=False)
    both = model.try_choices(seen, start)[2]
    assert (both[:, 1] > costs[:, 1]).any()  # first-impact harm counts half
    every = member_numbers(MIXTURE, np.arange(8), 0, "training")
    np.testing.assert_allclose(model.usual_costs(np.arange(8), np.zeros(8)), 0.98 * usual[every])
