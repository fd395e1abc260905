"""Several networks and a gate: what is looked for and learned, that a training stops, resumes and is refused."""

from __future__ import annotations

import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, Progress
from ethbrake_marl.learning.algorithms import (
    ModesModel,
    NoOtherMode,
    Stage,
    drive_from,
    explore,
    own_worlds,
    show_templates,
    stages_of,
    visit,
)
from ethbrake_marl.learning.runs import TrainResult, make_environment, make_model, resume, train
from ethbrake_marl.learning.training import ModesPlan, Training, load_recipe
from ethbrake_marl.policies import load_policy
from ethbrake_marl.search import profile_problem

SCENARIO = eb.load_scenario("paper-random")
SHIPPED = load_recipe("modes")
MODES = {
    "networks": 2,
    "gate": [4],
    "worlds": 64,
    "templates": 20,
    "gain": 0.0,
    "margin": 5.0,
    "imitation_epochs": 2,
    "gate_states": 32,
    "gate_memory": 100,
    "gate_steps": 4,
    "tie_break": 0.05,
    "together_rate": 0.5,
    "shares": {"alone": 0.25, "further": 0.25, "gate": 0.25, "together": 0.25},
}
TINY = SHIPPED.replace(
    start=None,
    observation=None,
    n_envs=8,
    n_steps=4,
    counterfactuals=16,
    batch_size=8,
    network={"policy": [8]},
    total_steps=512,
    modes=MODES,
    evaluation={"every_updates": 4, "worlds": 10, "seed": 7},
    checkpoint_every_updates=3,
)


def _model(**changes: Any) -> tuple[ModesModel, Any]:
    """A model of the tiny recipe, and the engine of its environment."""
    training = Training.of(TINY.replace(**changes), SCENARIO)
    with closing(make_environment(training)) as environment:
        environment.reset()
        model = make_model(training.recipe.make_algorithm(), training, environment)
        assert isinstance(model, ModesModel)
        return model, environment.engine


def _full_brake(seen: np.ndarray) -> np.ndarray:
    return np.full(len(seen), -1.0, np.float32)


def _coast(seen: np.ndarray) -> np.ndarray:
    return np.zeros(len(seen), np.float32)


def test_stages__share_the_updates_and_leave_none_out() -> None:
    plan = ModesPlan(**{**MODES, "networks": 3, "shares": {"alone": 0.5, "further": 0.2, "gate": 0.1, "together": 0.2}})
    assert stages_of(plan, 20) == (
        Stage("alone", 0, 0, 10),
        Stage("further", 1, 10, 12),
        Stage("further", 2, 12, 14),
        Stage("gate", 0, 14, 16),
        Stage("together", 0, 16, 20),
    )
    for updates in range(1, 30):
        found = stages_of(plan, updates)
        assert [s.first for s in found] == [0, *(s.end for s in found[:-1])] and found[-1].end == updates


def test_templates__are_played_as_they_were_found_and_depend_on_no_batch() -> None:
    """In each world the best of its own templates; below the bound, or none."""
    worlds = SCENARIO.sample(60, 3).worlds
    problem = profile_problem(worlds, [1])
    commands, steps = problem.best_templates(np.full(60, np.inf), number=40, seed=1)
    assert (steps > 0).all() and (commands >= problem.bounds[:, :, 0]).all()
    some = np.array([7, 31])
    assert np.array_equal(problem.take(some).best_templates(np.full(2, np.inf), number=40, seed=1)[0], commands[some])
    assert not np.array_equal(problem.best_templates(np.full(60, np.inf), number=40, seed=2)[0], commands)
    assert (problem.best_templates(np.zeros(60), number=40, seed=1)[1] == 0).all()  # no harm is below 0
    with pytest.raises(InvalidInput, match="templates: 2 vehicles; they are of one"):
        profile_problem(worlds, [1, 2]).best_templates(np.full(60, np.inf), number=40)
    with pytest.raises(InvalidInput, match="templates"):
        problem.best_templates(np.full(60, np.inf), number=0)


def test_shown__is_what_gains_more_than_every_network() -> None:
    model, engine = _model()
    found = explore(engine, model.plan, [_full_brake, _coast], 1.0)
    each = [drive_from(engine, found.start, act, 1.0) for act in (_full_brake, _coast)]
    assert np.array_equal(found.gained, np.maximum(each[0][0], each[1][0]))
    assert np.array_equal(found.harm, -found.gained)  # the recipe's reward is minus the harm by its own count
    shown = show_templates(engine, model.plan, found, 1.0, 0)
    assert len(shown.seen) == len(shown.action) > 50 and (np.abs(shown.action) <= 1.0).all()
    picky = ModesPlan(**{**MODES, "gain": 1e6})
    assert len(show_templates(engine, picky, found, 1.0, 0).action) == 0


def test_own_worlds__are_those_within_the_margin() -> None:
    model, engine = _model()
    found = explore(engine, model.plan, [_full_brake], 1.0)
    gained, _ = drive_from(engine, found.start, _coast, 1.0)
    own = own_worlds(engine, model.plan, found, _coast, 1.0)
    kept = (gained > found.gained - 5.0) & (found.harm > 0.0) & (np.abs(gained - found.gained) > 1e-2)
    assert 0 < len(own.state) < 64 and np.array_equal(own.state, found.start.state[kept])


def test_visit__every_decision_of_every_episode() -> None:
    _, engine = _model()
    _, start = engine.first_moments(20)
    seen, moments = visit(engine.branch(start), _full_brake)
    assert seen.shape == (len(moments.state), 1, 27)
    assert np.array_equal(moments.take(np.arange(20)).state, start.state)
    first = engine.branch(moments.take(np.arange(20))).observe_all(np.array([1]))
    assert np.array_equal(first, seen[:20])


def test_gate__learns_what_costs_least_and_what_matters_most() -> None:
    """Two kinds of decisions look alike; the gate is right where being wrong costs more."""
    modes = {**MODES, "gate_memory": 1000, "gate_steps": 20}
    model, _ = _model(learning_rate={"start": 1e-2, "end": 1e-2}, averaging=0.9, batch_size=128, modes=modes)
    model.set_logger(Logger(None, []))
    seen = np.zeros((300, 27), np.float32)
    seen[100:, 0] = 1.0
    costs = np.tile([0.0, 1.0], (300, 1))
    costs[100:] = [5.0, 0.0]
    costs[200:] = [0.0, 1.0]  # as the hundred before, seen from outside
    assert (model.policy.gate.choose(seen) == 0).all()
    for _ in range(20):
        model._train_gate(seen, costs)
    assert np.array_equal(model.policy.gate.choose(seen), np.repeat([0, 1, 1], 100))


def _weights(run: Path) -> list[bytes]:
    return [(run / name / "weights.safetensors").read_bytes() for name in ("policy", "policy-last")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainResult]:
    """The training that nobody stops, and its folder."""
    folder = tmp_path_factory.mktemp("modes") / "whole"
    return folder, train(TINY, SCENARIO, folder)


@pytest.mark.parametrize("at", [pytest.param(6, marks=pytest.mark.slow), 10, pytest.param(14, marks=pytest.mark.slow)])
def test_training__stops_in_any_stage_and_resumes_bit_for_bit(
    at: int, whole: tuple[Path, TrainResult], tmp_path: Path
) -> None:
    reference, expected = whole
    assert (expected.status, expected.steps, expected.updates) == ("finished", 512, 16)
    assert expected.policy.manifest.network.networks == 2 and expected.policy.manifest.format_version == 3

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == at:
            signal.raise_signal(signal.SIGINT)

    stopped = train(TINY, SCENARIO, tmp_path / "run", on_progress=ctrl_c)
    assert stopped.status == "interrupted" and 0 < stopped.updates < 16
    result = resume(tmp_path / "run")
    assert (result.status, result.evaluations) == ("finished", expected.evaluations)
    assert _weights(tmp_path / "run") == _weights(reference)
    assert eb.make_agent(f"counterfactual@{tmp_path / 'run'}", scenario=SCENARIO).name.startswith("counterfactual@")


def test_training__any_count_any_objective_any_line(tmp_path: Path) -> None:
    reward = {"harm": 1.0, "harm_count": "total", "objective": "own", "terminal": 0.5}
    recipe = TINY.replace(reward=reward, total_steps=256, modes={**MODES, "networks": 3})
    result = train(recipe, "cooperation-2-five", tmp_path / "run")
    assert result.status == "finished" and load_policy(tmp_path / "run").manifest.network.networks == 3


@pytest.mark.slow
def test_training__the_gate_gains_over_both_networks(tmp_path: Path) -> None:
    """The first network coasts, the second one imitates templates: the mixture does much better than the first."""
    recipe = TINY.replace(
        n_envs=64, total_steps=64 * 4 * 16, batch_size=64, averaging=0.9, network={"policy": [32]},
        learning_rate={"start": 3e-3, "end": 3e-3}, evaluation={"every_updates": 1000, "worlds": 300, "seed": 7},
        modes={**MODES, "worlds": 400, "imitation_epochs": 20, "gate_states": 512,
               "shares": {"alone": 0.0, "further": 0.25, "gate": 0.5, "together": 0.25}},
    )  # fmt: skip
    result = train(recipe, SCENARIO, tmp_path / "run")
    first, last = (result.evaluations[k]["first_impact_harm"] for k in (0, -1))
    assert last < 0.7 * first


def test_training__is_refused_for_several_learners_and_from_several_networks(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="recipe 'modes': modes: are for one learner, not for 2"):
        train(TINY, SCENARIO.with_learners(["vehicle_2", "vehicle_3"]), tmp_path / "two")
    train(TINY.replace(total_steps=32 * 4), SCENARIO, tmp_path / "first")
    start = f"counterfactual@{tmp_path / 'first'}"
    with pytest.raises(InvalidInput, match="start: has 2 networks; give a policy of one"):
        train(TINY.replace(start=start), SCENARIO, tmp_path / "again")


def test_training__says_that_there_is_no_other_mode(tmp_path: Path) -> None:
    with pytest.raises(NoOtherMode, match="network 2: in none of 64 worlds did one of 20 templates do better by 1e"):
        train(TINY.replace(modes={**MODES, "gain": 1e6}), SCENARIO, tmp_path / "run")
    assert load_policy(tmp_path / "run" / "policy-last").manifest.network.networks == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"networks": 1}, r"modes.networks = 1: must be greater than or equal to 2"),
        ({"shares": {"alone": 0.5, "further": 0.5, "gate": 0.5, "together": 0.0}}, r"are 1.5 in all; must be 1"),
        ({"margin": 0.0}, r"modes.margin = 0.*must be greater than 0"),
        ({"gat": [8]}, r"modes.gat: unknown key; did you mean gate"),
    ],
)
def test_recipe__refuses_what_cannot_be(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        TINY.replace(modes={**MODES, **changes})
