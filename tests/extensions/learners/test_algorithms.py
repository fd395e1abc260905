"""The algorithms vine, with a mixture of experts too, and rollout classification."""

import copy
import itertools
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.learners.branches import visit
from ethbrake_marl.extensions.learners.gradient_limit import limit_that_cuts, smallest_offset
from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan
from ethbrake_marl.extensions.learners.mixture_stages import stages_of
from ethbrake_marl.extensions.learners.mixture_worlds import (
    NoBetterTemplate,
    Shown,
    drive_from,
    explore,
    own_worlds,
    show_templates,
)
from ethbrake_marl.extensions.learners.optimizer import Adam
from ethbrake_marl.extensions.learners.scout import Scout, choose_rows, draw_rows
from ethbrake_marl.extensions.learners.start_weights import widened
from ethbrake_marl.extensions.learners.trust_radius import Tried, trusted_targets
from ethbrake_marl.extensions.learners.vine_model import VineModel
from ethbrake_marl.extensions.search.templates import best_templates
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.game.objectives import scored
from ethbrake_marl.first_edition.scenario.sampling import members_of
from ethbrake_marl.first_edition.training.finite import TrainingDiverged
from ethbrake_marl.first_edition.training.models import make_environment, make_model
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.session import train
from ethbrake_marl.first_edition.training.training import Training
from tests.extensions.learners.tiny import EXPERTS, TINY_EXPERTS, TINY_ROLLOUTS, TINY_VINE
from tests.first_edition.evaluation.test_rollout import check_beyond
from tests.first_edition.policies.test_networks import check_mixture

SCENARIO = eb.load_scenario("paper-random")


SHIPPED = load_recipe("vine")


SMALL = {name: getattr(TINY_VINE, name) for name in ("n_envs", "n_steps", "tried", "batch_size", "evaluation")}


STILL = {"learning_rate": {"start": 1e-12, "end": 1e-12}, "total_steps": 1}


def test_adam__is_torchs_without_its_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = []
    for kind in (torch.optim.Adam, Adam):
        weight = torch.nn.Parameter(torch.linspace(-1.0, 1.0, 30))
        optimizer = kind([weight], lr=1e-2, eps=1e-5)
        for step in range(4):
            optimizer.zero_grad()
            (weight.sin() * (step + weight)).sum().backward()
            optimizer.step()
        kind([weight]).load_state_dict(optimizer.state_dict())
        ended.append(weight.detach().numpy().tobytes())
        monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # whoever imports it from now on fails
    assert ended[0] == ended[1]


def test_training__starts_from_a_policy_and_drives_as_it_did(tmp_path: Path) -> None:
    """New features count for nothing at first: the same policy to the last bits, before anything is learned."""
    policy = train(SHIPPED.replace(**SMALL, **STILL), SCENARIO, tmp_path / "run", measure=None).policy
    agents = {"old": eb.LearnedAgent(eb.load_shipped("ppo")), "new": eb.LearnedAgent(policy)}
    found = eb.evaluate(SCENARIO.sample(50, 7).worlds, agents, scenario=SCENARIO)
    old, new = (found.outcome(name).first_impact_harm for name in agents)
    np.testing.assert_allclose(old, new, atol=1e-3)
    manifest = policy.manifest
    assert (manifest.algorithm, manifest.network.value_hidden) == ("vine", ())
    assert len(manifest.observation.features) == 57 and policy.observation.time_step_s == 0.1
    assert policy.tensors["policy.log_std"].shape == (1,)
    assert eb.make_agent(f"vine@{tmp_path / 'run'}").name == f"vine@{tmp_path / 'run'}"


@pytest.mark.parametrize("name", ["cooperation-4-all", "cooperation-2-five"])
def test_training__starts_from_nothing_where_no_policy_ships_and_says_so(tmp_path: Path, name: str) -> None:
    """With several learners, an obstacle ahead, or five vehicles: nearly full braking at first."""
    notes: list[str] = []
    tell = lambda progress: notes.append(progress.note)  # noqa: E731
    result = train(SHIPPED.replace(**SMALL, **STILL), name, tmp_path / "run", on_progress=tell)
    told = f"random weights, because no ppo is shipped for scenario {name!r}"
    assert json.loads((tmp_path / "run" / "run.json").read_text())["start"] == result.training.begins == told
    assert notes[0] == f"initial weights: {told}"
    assert result.policy.tensors["policy.output.bias"] == pytest.approx(-0.9, abs=1e-3)
    seen = np.random.default_rng(0).uniform(0, 1, (50, result.policy.observation.size)).astype(np.float32)
    np.testing.assert_allclose(result.policy(seen), -0.9, atol=0.1)
    fits = Training.of(SHIPPED, SCENARIO), Training.of(SHIPPED, "paper-random-obstacle")
    assert [each.begins for each in fits] == ["ppo", "ppo-obstacle"]
    assert (Training.of("quick", SCENARIO).begins, Training.of("ppo", SCENARIO).begins) == ("random weights", None)


OWN = {"reward": {"harm": 1.0, "harm_count": "total", "objective": "own", "terminal": 0.5}}


CONTACT = OWN | {"observation": ["own", "front_1", "rear_1", "contact"]}


SCRIPTED = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "best_harm:8"}


@pytest.mark.parametrize(
    ("recipe", "scenario"),
    [
        (TINY_VINE.replace(**CONTACT), SCENARIO.with_learners(["vehicle_2", "vehicle_3"])),
        (TINY_VINE.replace(**CONTACT), SCENARIO.with_learners(["vehicle_3"])),
        (TINY_VINE.replace(**CONTACT), eb.load_scenario("cooperation-2-five")),
        (TINY_VINE, SCENARIO.replace(early_impacts="keep", roles=SCRIPTED)),  # a script that remembers
        (TINY_EXPERTS.replace(**OWN, experts={**EXPERTS, "networks": 3}), eb.load_scenario("cooperation-2-five")),
        (TINY_ROLLOUTS.replace(**CONTACT), SCENARIO.with_learners(["vehicle_2", "vehicle_3"])),
        (TINY_ROLLOUTS.replace(**OWN), eb.load_scenario("cooperation-2-five")),
    ],
)
def test_training__of_any_learners_objective_and_line(recipe: Any, scenario: Any, tmp_path: Path) -> None:
    told: list[eb.Progress] = []
    result = train(recipe, scenario, tmp_path / "run", steps=8 * 32 * len(scenario.learners), on_progress=told.append)
    assert told[-1].harm.partition(" harm ")[0] == {"first": "first-impact", "total": "total"}[recipe.reward.harm_count]
    assert result.status == "finished" and result.updates == 8
    networks = 3 if getattr(recipe, "experts", None) else 1
    assert eb.load_policy(tmp_path / "run").manifest.network.networks == networks


FROM_SCRATCH = {
    "n_envs": 64, "batch_size": 64, "averaging": 0.9, "network": {"policy": [32]},
    "learning_rate": {"start": 3e-3, "end": 3e-3}, "evaluation": {"every_updates": 1000, "worlds": 300, "seed": 7},
}  # fmt: skip


SHARES = {"pretraining_first": 0.0, "pretraining_others": 0.25, "gating": 0.5, "joint": 0.25}


MANY_TRIED = {"n_steps": 8, "tried": 256, "total_steps": 30 * 512}


GATED = {
    "total_steps": 16 * 256,
    "experts": EXPERTS | {"worlds": 400, "imitation_epochs": 20, "gating_states": 512, "shares": SHARES},
}


CHOOSING = {
    "n_steps": 8, "tried": 256, "memory": 4000, "gradient_steps": 60, "total_steps": 12 * 512,
    "network": {"policy": [32], "choices": 9},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "recipe",
    [
        SHIPPED.replace(start=None, **FROM_SCRATCH, **MANY_TRIED),
        TINY_EXPERTS.replace(**FROM_SCRATCH, **GATED),
        TINY_ROLLOUTS.replace(**FROM_SCRATCH | CHOOSING),
    ],
)
def test_training__gets_better_from_scratch(recipe: Any, tmp_path: Path) -> None:
    """Random weights hardly act: much of the harm is gone by trying, or by imitating templates."""
    result = train(recipe, SCENARIO, tmp_path / "run")
    first, last = (result.evaluations[k]["first_impact_harm"] for k in (0, -1))
    assert last < 0.7 * first


def test_training__numbers_that_are_not_finite_stop_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = VineModel._try_out, itertools.count(1)

    def broken(self: VineModel, seen: Any, moments: Any, actor: Any) -> Tried:
        tried = real(self, seen, moments, actor)
        return tried._replace(mean=tried.mean * np.float32(np.nan if next(calls) == 3 else 1.0))

    monkeypatch.setattr(VineModel, "_try_out", broken)
    with pytest.raises(TrainingDiverged, match="not finite"):
        train(TINY_VINE, SCENARIO, tmp_path / "run", measure=None)
    kept = eb.load_policy(tmp_path / "run" / "policy-last")
    assert all(np.isfinite(tensor).all() for tensor in kept.tensors.values())


def new_model(recipe: TrainingRecipe, scenario: eb.Scenario = SCENARIO) -> Any:
    """What is trained, before its first update."""
    training = Training.of(recipe, scenario)
    model: Any = make_model(training.recipe.make_algorithm(), training, make_environment(training))
    model._setup_learn(1)
    model.set_logger(Logger(None, []))
    return model


def choosing(scenario: eb.Scenario = SCENARIO, **changes: Any) -> Any:
    """A new model of rollout classification."""
    return new_model(TINY_ROLLOUTS.replace(**changes), scenario)


def constant(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda seen: np.full(len(seen), value, np.float32)


_full_brake, _coast = constant(-1.0), constant(0.0)


def test_stages__share_the_updates_and_leave_none_out() -> None:
    plan = ExpertsPlan(
        **{
            **EXPERTS,
            "networks": 3,
            "shares": {"pretraining_first": 0.5, "pretraining_others": 0.2, "gating": 0.1, "joint": 0.2},
        }
    )
    expected = [("first", 0, 0, 10), ("other", 1, 10, 12), ("other", 2, 12, 14), ("gating", 0, 14, 16),
                ("joint", 0, 16, 20)]  # fmt: skip
    assert [*stages_of(plan, 20)] == expected
    for updates in range(1, 30):
        found = stages_of(plan, updates)
        assert [s.first for s in found] == [0, *(s.end for s in found[:-1])] and found[-1].end == updates


def test_templates__are_played_as_they_were_found_and_depend_on_no_batch() -> None:
    """In each world the best of its own templates; below the bound, or none."""
    problem, open_ended = profile_problem(SCENARIO.sample(40, 3).worlds, [1]), np.full(40, np.inf)
    commands, steps = best_templates(problem, open_ended, number=40, seed=1)
    assert (steps > 0).all() and (commands >= problem.bounds[:, :, 0]).all()
    some = np.array([7, 31])
    assert np.array_equal(best_templates(problem.take(some), np.full(2, np.inf), number=40, seed=1)[0], commands[some])
    assert not np.array_equal(best_templates(problem, open_ended, number=40, seed=2)[0], commands)
    assert (best_templates(problem, np.zeros(40), number=40, seed=1)[1] == 0).all()  # no harm is below 0


def test_shown__is_what_gains_more_than_every_network() -> None:
    model = new_model(TINY_EXPERTS)
    engine = model.engine
    found = explore(engine, model.plan, [_full_brake, _coast], 1.0)
    each = [drive_from(engine, found.start, act, 1.0) for act in (_full_brake, _coast)]
    assert np.array_equal(found.gained, np.maximum(each[0][0], each[1][0]))
    assert np.array_equal(found.harm, -found.gained)  # the recipe's reward is minus the harm by its own count
    shown = show_templates(engine, model.plan, found, 1.0, 0)
    assert len(shown.seen) == len(shown.action) > 50 and (np.abs(shown.action) <= 1.0).all()
    picky = ExpertsPlan(**{**EXPERTS, "gain": 1e6})
    assert len(show_templates(engine, picky, found, 1.0, 0).action) == 0


def test_own_worlds__are_those_within_the_margin() -> None:
    model = new_model(TINY_EXPERTS)
    engine = model.engine
    found = explore(engine, model.plan, [_full_brake], 1.0)
    gained, _ = drive_from(engine, found.start, _coast, 1.0)
    own = own_worlds(engine, model.plan, found, _coast, 1.0)
    kept = (gained > found.gained - 5.0) & (found.harm > 0.0) & (np.abs(gained - found.gained) > 1e-2)
    assert 0 < len(own.motion) < 64 and np.array_equal(own.motion, found.start.motion[kept])


def test_visit__every_decision_of_every_episode() -> None:
    engine = new_model(TINY_EXPERTS).engine
    _, start = engine.first_moments(20)
    seen, moments = visit(engine.branch(start), _full_brake)
    assert seen.shape == (len(moments.motion), 1, 27)
    assert np.array_equal(moments.take(np.arange(20)).motion, start.motion)
    first = engine.branch(moments.take(np.arange(20))).observe_all(np.array([1]))
    assert np.array_equal(first, seen[:20])


def test_gate__learns_what_costs_least_and_what_matters_most() -> None:
    """Of two kinds of decisions that look alike the gate is right where being wrong costs more, or counts for more."""
    plan = {**EXPERTS, "gating_memory": 1000, "gating_steps": 20}
    fast = {"learning_rate": {"start": 1e-2, "end": 1e-2}, "averaging": 0.9, "batch_size": 128}
    model = new_model(TINY_EXPERTS.replace(**fast, experts=plan))
    seen = np.repeat(np.eye(27, dtype=np.float32)[[0, 1, 1, 2, 2]], 100, axis=0)
    costs = np.repeat([[0.0, 1.0], [5.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 4.0]], 100, axis=0)
    importance = np.repeat(np.float32([1.0, 1.0, 1.0, 4.0, 0.5]), 100)
    assert (model.policy.gate.choose(seen) == 0).all()
    for _ in range(20):
        model._train_gate(seen, costs, importance)
    assert np.array_equal(model.policy.gate.choose(seen), np.repeat([0, 1, 1, 1, 1], 100))


def test_imitation__draws_from_the_stream_of_its_own_seed() -> None:
    model = new_model(TINY_EXPERTS.replace(batch_size=8))
    rng, taught = np.random.default_rng(0), []
    shown = Shown(rng.random((32, 27), np.float32), rng.random(32, np.float32))
    for seed in (1, 1, 2):
        pupil = copy.deepcopy(model.policy.actors[0])
        model._imitate(pupil, shown, seed)
        taught.append(pupil.act(shown.seen).tolist())
    assert taught[0] == taught[1] != taught[2]


def test_training__says_that_no_template_does_better(tmp_path: Path) -> None:
    with pytest.raises(
        NoBetterTemplate, match=r"expert 2 has nothing to learn: in none of 64 worlds does one of 20 random"
    ):
        train(TINY_EXPERTS.replace(experts={**EXPERTS, "gain": 1e6}), SCENARIO, tmp_path / "run", measure=None)
    assert eb.load_policy(tmp_path / "run" / "policy-last").manifest.network.networks == 2


def test_drawn__mean_with_their_importance_is_the_mean_of_all() -> None:
    """One row in ten is worth 5, the others nothing: half a million draws know the mean, 0.5, to a hundredth."""
    torch.manual_seed(0)
    value = np.where(np.arange(1000) < 100, 5.0, 0.0)
    expected = np.where(value > 0.0, 1.0, 1e-3)
    rows, importance = draw_rows(expected, 500_000, 0.75)
    assert np.mean(value[rows] * importance) == pytest.approx(value.mean(), rel=1e-2)
    assert importance.mean() == pytest.approx(1.0, rel=1e-2)
    assert np.mean(rows < 100) == pytest.approx(0.75 * 100 / 100.9 + 0.25 * 0.1, abs=5e-3)
    assert importance.max() <= 4.0  # 1 / (1 - focus)


def test_chosen__without_focus_each_row_once() -> None:
    torch.manual_seed(0)
    observed, rows = np.zeros((50, 3), np.float32), np.arange(10, 30)
    chosen, importance = choose_rows(observed, rows, 15, 0.0, lambda seen: pytest.fail("nobody is asked"))
    assert len(set(chosen.tolist())) == 15 and set(chosen.tolist()) <= set(range(10, 30))
    assert (importance == 1.0).all()
    drawn = [
        choose_rows(observed, of, n, 0.5, lambda seen: np.ones(len(seen)))[0] for of, n in ((rows[:0], 15), (rows, 40))
    ]
    assert [len(each) for each in drawn] == [0, 40]


def test_scout__learns_the_mean_size_of_what_is_to_be_expected() -> None:
    """Half of the decisions are worth 3 on average (0 or 6), the others nothing."""
    torch.manual_seed(0)
    scout = Scout(2)
    kind = torch.arange(400) % 2
    seen, size = torch.nn.functional.one_hot(kind, 2).float(), kind * 6.0 * (torch.arange(400) % 4 == 1)
    optimizer = torch.optim.Adam(scout.parameters(), lr=1e-2)
    for _ in range(400):
        optimizer.zero_grad()
        scout.loss(seen, size, torch.ones(400)).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    expected = scout.expect(np.eye(2, dtype=np.float32))
    assert expected[1] == pytest.approx(3.0, rel=0.05) and expected[0] < 0.05


def test_gradients__are_cut_at_their_limit_and_the_share_is_told() -> None:
    found = {}
    for limit in (0.01, 1e9):
        model = new_model(TINY_VINE.replace(gradient_limit=limit))
        torch.manual_seed(5)
        tried = model._try_out(model._last_obs[np.newaxis], model.engine.moment(), model.policy)
        found[limit] = tried.gradient, model.logger.name_to_value["train/gradient_cut"]
    (cut, share), (whole, none) = found.values()
    assert np.abs(whole).max() > 0.1 and none == 0.0
    np.testing.assert_array_equal(cut, np.clip(whole, -0.01, 0.01))
    assert share == pytest.approx(1.0 - np.abs(cut).sum() / np.abs(whole).sum(), rel=1e-5)


def test_automatic_limit__cuts_its_share_and_offsets_grow_where_harm_jumps() -> None:
    random = np.random.default_rng(0)
    sizes, offsets = np.abs(random.standard_cauchy(9_000)), 0.003 * (100.0 / 3.0) ** random.random(9_000)
    kept = np.minimum(sizes, limit_that_cuts(sizes, 0.1))
    assert kept.sum() == pytest.approx(0.9 * sizes.sum()) and limit_that_cuts(np.zeros(3), 0.1) == 0.0
    jumps = np.where(random.random(9_000) < offsets, 5.0 / (2.0 * offsets), 0.0)  # met in proportion to the offset
    smooth = random.standard_normal(9_000)
    found = [smallest_offset(np.stack([each, offsets], axis=1), 0.003, 0.1) for each in (jumps, np.abs(smooth))]
    assert 0.015 < found[0] <= 0.025 and found[1] == 0.003
    assert smallest_offset(np.zeros((4, 2)), 0.01, 0.3) == 0.01


@pytest.mark.parametrize(("objective", "learners"), [("total", ["vehicle_2"]), ("own", ["vehicle_2", "vehicle_3"])])
def test_rollout_classification__costs_are_those_of_the_moved_learner_in_episodes_driven_so(
    objective: str, learners: list[str]
) -> None:
    """Full braking of all but for what is tried: each action for its steps, then the policy, to the end."""
    line, rows = SCENARIO.with_learners(learners).replace(objective=objective), np.arange(8 * len(learners))
    model = choosing(
        line, tried=len(rows), near=[], fixed=[1.0], drawn=1, holds=[3], network={"policy": [8], "choices": 5}
    )
    start = model.engine.moment()
    torch.manual_seed(5)
    seen, tried, costs = model._try_actions(model._last_obs[np.newaxis], start)
    order, rows = np.argsort(seen[:, 0]), np.argsort(model._last_obs[:, 0])
    assert len(tried) == len(rows) and (tried[:, :2] == [0, 4]).all() and len(set(tried[:, 2])) > 1
    world, moved = np.divmod(rows, len(learners))
    for way in range(3):
        engine = model.engine.branch(start.take(world))
        for step in range(200):
            action = np.full((len(rows), len(learners)), -1.0)
            if step < 3:
                action[np.arange(len(rows)), moved] += 0.5 * tried[order, way]
            engine.step(action)
            if engine.ended.all():
                break
        harm = scored(engine.ledger, "total")[objective][np.arange(len(rows)), moved + 1]
        np.testing.assert_allclose(costs[order, way], harm, rtol=1e-12, atol=1e-12)
    model.recipe = model.recipe.replace(caution=2.0)  # what goes beyond full braking, here the policy
    model._update_current_progress_remaining(1, 2)  # half of it by now
    torch.manual_seed(5)
    cautious, beyond = model._try_actions(model._last_obs[np.newaxis], start)[2], np.maximum(costs - costs[:, :1], 0.0)
    assert beyond.max() > 0.1
    np.testing.assert_allclose(cautious, costs + beyond, rtol=1e-12, atol=1e-12)


def test_rollout_classification__loss_by_hand_and_what_is_remembered_last() -> None:
    actor = choosing(
        tried=2, memory=2, near=[], fixed=[0.0, 1.0], drawn=0, network={"policy": [8], "choices": 3}
    ).policy
    seen, tried = np.zeros((2, actor.seen.shape[1]), np.float32), np.array([[0, 1, 2], [0, 1, 2]])
    actor.remember(seen, tried, np.array([[9.0, 9.0, 9.0], [0.0, 2.0, 4.0]]))
    actor.remember(seen[:1], tried[:1], np.array([[0.0, 2.0, 4.0]]))
    assert int(actor.known) == 3 and actor.more.tolist() == [[0.0, 2.0, 4.0], [0.0, 2.0, 4.0]]
    with torch.no_grad():
        actor.learning[-1].bias.copy_(torch.log(torch.tensor([1.0, 2.0, 3.0])))
    expected, convex = (2.0 * 2.0 + 4.0 * 3.0) / 6.0, 2.0 * math.log(1.0 + 2.0) + 4.0 * math.log(1.0 + 3.0)
    (kept,) = actor.draw(1, 4, 0.0)
    assert actor.loss(*kept, 0.0).item() == pytest.approx(expected)
    assert actor.loss(*kept, 0.1).item() == pytest.approx(expected + 0.1 * convex)
    actor.more[0] = 0.0  # nothing to lose: hardly drawn any more, but what is drawn counts as before on average
    batches = [*actor.draw(50, 40, 0.8)]
    rows, importance = (torch.cat(each) for each in zip(*batches, strict=True))
    assert [len(some) for some, _ in batches] == [40] * 50 and float((rows == 1).float().mean()) > 0.85
    assert [float(importance[rows == row].sum()) / 1000 for row in (0, 1)] == pytest.approx([1.0, 1.0], abs=0.2)


def test_rollout_classification__policies_drive_as_alone_and_costs_are_beside_those_usual_in_each_scenario() -> None:
    line = eb.load_scenario(
        {"name": "two", "mixture": [{"scenario": "paper-random"}, {"scenario": "paper-delay-high"}]}
    )
    policies, shape = ["ppo", "sac"], {"policy": [8], "choices": 2}
    model = choosing(line, policies=policies, tried=8, near=[], fixed=[-1.0], drawn=2, holds=[1000], network=shape)
    start = model.engine.moment()
    model._numbers = model.engine.roster.numbers.copy()
    torch.manual_seed(5)
    seen, tried, costs = model._try_actions(model._last_obs[np.newaxis], start)
    order, rows = np.argsort(seen[:, 0]), np.argsort(model._last_obs[:, 0])
    assert (tried[:, 0] == 0).all() and (tried[:, 1] == 2).all() and (np.sort(tried[:, 2:]) == [0, 1]).all()
    alone = [eb.load_shipped("ppo"), eb.load_shipped("sac"), lambda now: np.full((len(now), 1), -1.0)]
    for number, act in enumerate(alone):
        engine = model.engine.branch(start.take(rows))
        for _ in range(200):
            engine.step(act(engine.observe_all()[:, 0]).astype(np.float64))
            if engine.ended.all():
                break
        found = costs[order][tried[order] == number].reshape(len(rows), -1)
        np.testing.assert_allclose(found.T, np.tile(engine.ledger.world_harm("total"), (found.shape[1], 1)), rtol=1e-3)
    model.recipe = model.recipe.replace(relative=True, tie_break=0.5)
    torch.manual_seed(5)
    both = model._try_actions(model._last_obs[np.newaxis], start)[2]
    usual = model.policy.usual.numpy()
    assert (usual > 0.0).all() and usual[0] < usual[1]
    member = members_of(line, 8, model.engine.seed, channel="training")
    least = both[order].min(axis=1)
    for m in range(2):  # the first time what is usual is the mean of these
        assert least[member[rows] == m].mean() == pytest.approx(1.0)


def test_trusted_targets__keep_the_slope_and_never_leave_the_radius() -> None:
    # Targets keep the slope and never leave the trust radius: with r = 0.05 and k = 3, g = 0.15 moves by 0.15 / (3 +
    # 3), g = 1e6 by almost 0.05, g = 0 not at all; and no target is beyond an action that is allowed.
    gradient = np.array([0.0, 0.15, -0.15, 1e6, 1e6, 0.15, -1e6, -0.15, -1e6], np.float32)
    mean = np.array([0.3, 0.0, 0.0, 0.0, 1.0, -2.0, -2.0, 2.0, -1.0], np.float32)
    tried = Tried(np.zeros((9, 1), np.float32), mean, gradient, np.ones(9, np.float32))
    target, weight = trusted_targets(tried, 0.05, 3.0)
    assert [round(float(each), 6) for each in target] == [0.3, 0.025, -0.025, 0.05, 1.0, -1.975, -2.0, 1.975, -1.0]
    assert [round(float(each), 5) for each in weight[[0, 1, 2, 4]]] == [3.0, 6.0, 6.0, 3.0]
    assert [round(float(each), 5) for each in (weight * (target - mean))[:3]] == [0.0, 0.15, -0.15]
    assert round(float(weight[3] * target[3]) / 1e6, 4) == 1.0


def test_widened_policy__keeps_the_weights_of_its_features_and_nothing_of_new_ones() -> None:
    shipped, scenario = eb.load_shipped("ppo"), eb.load_scenario("paper-random")
    turned = ["contact.brake_total_harm", *reversed(shipped.manifest.observation.features)]
    wide = widened(shipped, Training.of(SHIPPED.replace(observation=turned), scenario))
    first = wide["policy.0.weight"]
    assert not first[:, 0].any()
    assert (first[:, 1:] == shipped.tensors["policy.0.weight"][:, ::-1]).all()
    assert "value.0.weight" not in wide


@pytest.mark.parametrize("around", ["+episode", "+step", "+search"])
def test_mixture__drives_shielded_and_searched(around: str, mixture: eb.Policy, tmp_path: Path) -> None:
    check_mixture("vine", around, mixture, tmp_path)


def test_policy__that_drives_beyond_what_it_was_trained_for_is_told_so_once() -> None:
    check_beyond("rollout-obstacle", SCENARIO, "no obstacle_gap_m")
