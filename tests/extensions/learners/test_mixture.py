"""A mixture of experts: stages, templates, worlds, and the gating network."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.learners.mixture import NoBetterTemplate, Shown, random_templates, stages_of
from ethbrake_marl.extensions.learners.recipes import ExpertsPlan
from ethbrake_marl.training.train import train
from tests.extensions.learners.tiny import EXPERTS, PAPER, PLAN, new_model


def full_brake(seen: np.ndarray) -> np.ndarray:
    return np.full(len(seen), np.float32(-1.0))


def coast(seen: np.ndarray) -> np.ndarray:
    return np.zeros(len(seen), np.float32)


def test_stages__follow_each_other_and_get_their_shares() -> None:
    plan = ExpertsPlan(**PLAN | {"networks": 3})
    found = [tuple(stage) for stage in stages_of(plan, 16)]
    assert found == [(0, 0, 4), (1, 4, 6), (2, 6, 8), (None, 8, 16)]
    assert [stage.end for stage in stages_of(plan, 3)] == [1, 2, 2, 3]  # rounded up, so the first is never left out


def test_templates__are_one_action_another_for_a_while_then_full_braking() -> None:
    plans = random_templates(np.random.default_rng(0), 2000, 30, 8)
    assert plans.shape == (2000, 38) and (np.abs(plans) <= 1.0).all()
    changes = (np.diff(plans, axis=1) != 0.0).sum(axis=1)
    assert changes.max() == 2 and 0.7 < (plans[:, 0] == -1.0).mean() < 0.95
    whiles = [np.ptp(np.flatnonzero(plan != -1.0)) + 1 for plan in plans if plan[0] == -1.0 and (plan != -1.0).any()]
    assert max(whiles) == 8 and min(whiles) == 1
    free = plans[(plans != -1.0) & (plans != 1.0) & (plans != 0.0)]
    assert -1.0 < free.min() < -0.9 and 0.9 < free.max() < 1.0


def test_shown__are_the_decisions_of_templates_that_gain_more_than_every_expert() -> None:
    model = new_model(EXPERTS)
    explored = model.explore([full_brake, coast])
    each = [model.drive_from(explored.start, act, "first") for act in (full_brake, coast)]
    assert np.array_equal(explored.gained, np.maximum(each[0][0], each[1][0]))
    assert np.array_equal(explored.harm, -explored.gained) and each[0][1].mean() > 10.0
    rows, actions = model.best_templates(explored)
    assert 0 < len(rows) < 64
    plan = actions[:1, :, np.newaxis]
    harm = eb.price(model.game, explored.start.take(rows[:1]), plan, "first")
    assert harm[0] < explored.harm[rows[0]]
    shown = model.show(explored, rows, actions)
    assert len(shown.seen) == len(shown.action) > 50
    first = model.game.observe_alike(explored.start.take(rows), [2])[:, 0]
    np.testing.assert_array_equal(shown.seen[: len(rows)], first)
    np.testing.assert_array_equal(shown.action[: len(rows)], actions[:, 0].astype(np.float32))
    model.plan = ExpertsPlan(**PLAN | {"gain": 1e6})
    assert len(model.show(explored, rows, actions).action) == 0


def test_worlds_of_an_expert__are_those_within_the_margin() -> None:
    model = new_model(EXPERTS)
    explored = model.explore([full_brake])
    gained, _ = model.drive_from(explored.start, coast, "first")
    own = model.worlds_of(coast, explored)
    kept = (gained > explored.gained - 5.0) & (explored.harm > 0.0) & (np.abs(gained - explored.gained) > 1e-2)
    assert 0 < own.n < 64 and np.array_equal(own.line, explored.start.line[kept])


def test_compared_experts__cost_what_they_do_by_both_counts() -> None:
    model = new_model(EXPERTS)
    states, seen = model.rows.episode.take(np.arange(8)), model._last_obs
    for actor, act in zip(model.policy.actors, (full_brake, coast), strict=True):
        actor.act = act
    found, costs = model.compare(seen, states)
    assert len(found) == 8
    for k, act in enumerate((full_brake, coast)):
        gained, total = model.drive_from(states, act, "total")
        order = [int(np.flatnonzero((seen == row).all(axis=1))[0]) for row in found]
        np.testing.assert_allclose(costs[:, k], (0.05 * total - gained)[order], rtol=1e-12)


def test_gate__learns_what_costs_least_and_what_matters_most() -> None:
    """Of two kinds of decisions that look alike, the gate is right where being wrong costs more."""
    fast = {"learning_rate": {"start": 1e-2, "end": 1e-2}, "batch_size": 128}
    model = new_model(EXPERTS.replace(**fast, experts={**PLAN, "gating_memory": 1000, "gating_steps": 20}))
    seen = np.repeat(np.eye(27, dtype=np.float32)[[0, 1, 1]], 100, axis=0)
    costs = np.repeat([[0.0, 1.0], [5.0, 0.0], [0.0, 1.0]], 100, axis=0)
    assert (model.policy.gate.best(seen) == 0).all()
    for _ in range(20):
        model.train_gate(seen, costs)
    assert np.array_equal(model.policy.gate.best(seen), np.repeat([0, 1, 1], 100))
    biased = [np.sign(full_brake(seen)), np.sign(coast(seen))]
    model.policy.actors[0].means, model.policy.actors[1].means = full_brake, coast
    np.testing.assert_array_equal(model.policy.act(seen), np.where(np.repeat([0, 1, 1], 100), biased[1], biased[0]))


def test_imitation__comes_close_in_an_order_of_its_own() -> None:
    model = new_model(EXPERTS.replace(batch_size=8, experts={**PLAN, "imitation_epochs": 60}))
    rng, taught = np.random.default_rng(0), []
    shown = Shown(rng.random((32, 27), np.float32), rng.uniform(-1.0, 1.0, 32).astype(np.float32))
    shown.action[:2] = 1.0
    for seed in (1, 1, 2):
        pupil = copy.deepcopy(model.policy.actors[0])
        model.imitate(pupil, shown, seed)
        taught.append(pupil.act(shown.seen))
    assert np.array_equal(taught[0], taught[1]) and not np.array_equal(taught[0], taught[2])
    assert np.abs(taught[0] - shown.action).mean() < 0.3 * np.abs(shown.action).mean()


def test_training__says_that_no_template_does_better(tmp_path: Path) -> None:
    with pytest.raises(NoBetterTemplate, match=r"expert 2 has nothing to learn: in none of 64 worlds does one of 20"):
        train(EXPERTS.replace(experts={**PLAN, "gain": 1e6}), PAPER, tmp_path / "run", measure=None, on_progress=None)
    assert eb.load_policy(tmp_path / "run" / "policy-last").manifest.network.networks == 2
