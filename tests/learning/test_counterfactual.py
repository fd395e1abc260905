"""Learning from counterfactuals: where it starts, what it regresses on, that it stops, resumes, and gets better."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, Progress
from ethbrake_marl.learning.algorithms import Adam, CounterfactualModel, Tried, trusted_targets, widened
from ethbrake_marl.learning.runs import TrainingDiverged, resume, train
from ethbrake_marl.learning.training import Training, load_recipe
from ethbrake_marl.policies import load_policy

SCENARIO = eb.load_scenario("paper-random")
SHIPPED = load_recipe("counterfactual")
TINY = SHIPPED.replace(
    start=None,
    observation=None,
    n_envs=8,
    n_steps=4,
    counterfactuals=16,
    batch_size=8,
    network={"policy": [8]},
    total_steps=512,
    evaluation={"every_updates": 4, "worlds": 10, "seed": 7},
    checkpoint_every_updates=3,
)
FEATURES = ["own", "front_1", "rear_1", "contact"]


def weights(run: Path) -> list[bytes]:
    return [(run / name / "weights.safetensors").read_bytes() for name in ("policy", "policy-last")]


def test_targets__keep_the_slope_and_never_leave_the_trust_radius() -> None:
    """By hand, r = 0.05 and k = 3: g = 0.15 moves by 0.15 / (3 + 3), g = 1e6 by almost 0.05, g = 0 not at all."""
    gradient = np.array([0.0, 0.15, -0.15, 1e6, 1e6, 0.15, -1e6, -0.15], np.float32)
    mean = np.array([0.3, 0.0, 0.0, 0.0, 1.0, -2.0, -2.0, 2.0], np.float32)
    target, weight = trusted_targets(
        Tried(np.zeros((8, 1), np.float32), mean, gradient, np.ones(8, np.float32)), 0.05, 3.0
    )
    np.testing.assert_allclose(target, [0.3, 0.025, -0.025, 0.05, 1.0, -1.975, -2.0, 1.975], rtol=1e-5)
    np.testing.assert_allclose(weight[[0, 1, 2, 4]], [3.0, 6.0, 6.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose((weight * (target - mean))[:4], gradient[:4], rtol=1e-5)  # the slope where it stands


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
    recipe = SHIPPED.replace(**_small(total_steps=1), learning_rate={"start": 1e-12, "end": 1e-12})
    result = train(recipe, SCENARIO, tmp_path / "run")
    shipped = eb.load_shipped("ppo")
    worlds = SCENARIO.sample(50, 7)
    agents = {"old": eb.LearnedAgent(shipped), "new": eb.LearnedAgent(result.policy)}
    found = eb.evaluate(worlds, agents, scenario=SCENARIO)
    harm = [found.outcome(name).first_impact_harm for name in agents]
    np.testing.assert_allclose(harm[0], harm[1], atol=1e-3)
    manifest = result.policy.manifest
    assert manifest.algorithm == "counterfactual" and manifest.network.value_hidden == ()
    assert len(manifest.observation.features) == 57 and result.policy.observation.time_step_s == 0.1
    assert result.policy.tensors["policy.log_std"].shape == (1,)


def _small(**changes: Any) -> dict[str, Any]:
    evaluation = {"every_updates": 1000, "worlds": 200, "seed": 7}
    return {"n_envs": 64, "n_steps": 8, "counterfactuals": 256, "evaluation": evaluation, **changes}


def test_widened__puts_every_feature_where_it_is_observed_now() -> None:
    shipped = eb.load_shipped("ppo")
    names = list(shipped.manifest.observation.features)
    turned = Training.of(SHIPPED.replace(observation=["contact.brake_total_harm", *reversed(names)]), SCENARIO)
    first = widened(shipped, turned)["policy.0.weight"]
    assert (first[:, 0] == 0.0).all()
    assert (first[:, 1:] == shipped.tensors["policy.0.weight"][:, ::-1]).all()
    assert "value.0.weight" not in widened(shipped, turned)
    with pytest.raises(InvalidInput, match=r"observation: lacks rear_1.known, .* which the policy"):
        widened(shipped, Training.of(SHIPPED.replace(observation=["own", "front_1", "contact"]), SCENARIO))
    with pytest.raises(InvalidInput, match=r"policy_hidden is \(64, 64\), but \(128, 128\) in the policy"):
        widened(shipped, Training.of(SHIPPED.replace(network={"policy": [64, 64]}), SCENARIO))


def test_training__stops_and_resumes_bit_for_bit(tmp_path: Path) -> None:
    whole = train(TINY, SCENARIO, tmp_path / "whole")
    assert (whole.status, whole.steps, whole.updates) == ("finished", 512, 16)
    assert train(TINY, SCENARIO, tmp_path / "again").evaluations == whole.evaluations

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == 7:
            signal.raise_signal(signal.SIGINT)

    stopped = train(TINY, SCENARIO, tmp_path / "run", on_progress=ctrl_c)
    assert stopped.status == "interrupted" and 0 < stopped.updates < 16
    result = resume(tmp_path / "run")
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole") == weights(tmp_path / "again")
    table = [(tmp_path / run / "progress.csv").read_text() for run in ("run", "whole")]
    assert table[0].splitlines()[-1].split(",")[1:] == table[1].splitlines()[-1].split(",")[1:] or table[0] == table[1]
    assert "train/gradient" in table[0]
    outcome = eb.make_agent(f"counterfactual@{tmp_path / 'run'}", scenario=SCENARIO)
    assert outcome.name == f"counterfactual@{tmp_path / 'run'}"


@pytest.mark.parametrize("learners", [["vehicle_2", "vehicle_3"], ["vehicle_3"]])
def test_training__any_learners_any_objective_any_line(tmp_path: Path, learners: list[str]) -> None:
    scenario = SCENARIO.with_learners(learners)
    reward = {"harm": 1.0, "harm_count": "total", "objective": "own", "terminal": 0.5}
    recipe = TINY.replace(reward=reward, observation=FEATURES, total_steps=64 * len(learners))
    result = train(recipe, scenario, tmp_path / "run")
    assert result.updates == 2 and result.status == "finished"
    longer = eb.load_scenario("cooperation-2-five")
    assert train(recipe.replace(total_steps=32), longer, tmp_path / "longer").status == "finished"


@pytest.mark.slow
def test_training__gets_better_from_scratch(tmp_path: Path) -> None:
    """Random weights hardly act; after 30 updates of 256 counterfactuals much of the harm of coasting is gone."""
    recipe = SHIPPED.replace(
        **_small(total_steps=30 * 512, start=None, network={"policy": [32]}, batch_size=64, averaging=0.9),
        learning_rate={"start": 3e-3, "end": 3e-3},
    )
    result = train(recipe, SCENARIO, tmp_path / "run")
    first, last = (result.evaluations[k]["first_impact_harm"] for k in (0, -1))
    assert last < 0.7 * first


def test_training__begins_near_an_action(tmp_path: Path) -> None:
    """Where the recipe says so: -0.9 is nearly full braking. A recipe without it is the training that it always was."""
    recipe = TINY.replace(network={"policy": [8], "initial_action": -0.9}, learning_rate={"start": 1e-12, "end": 1e-12})
    policy = train(recipe.replace(total_steps=1), SCENARIO, tmp_path / "run").policy
    seen = np.random.default_rng(0).uniform(0, 1, (50, policy.manifest.network.observation_size)).astype(np.float32)
    np.testing.assert_allclose(policy(seen), -0.9, atol=0.1)
    assert "initial_action" not in TINY.model_dump()["network"]
    with pytest.raises(InvalidInput, match=r"initial_action = -1\.5"):
        TINY.replace(network={"policy": [8], "initial_action": -1.5})


def test_training__numbers_that_are_not_finite_stop_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = CounterfactualModel._try_out
    calls = []

    def broken(self: CounterfactualModel, seen: Any, moments: Any, actor: Any) -> Tried:
        tried = real(self, seen, moments, actor)
        calls.append(1)
        return tried._replace(mean=tried.mean * np.float32(np.nan)) if len(calls) == 3 else tried

    monkeypatch.setattr(CounterfactualModel, "_try_out", broken)
    with pytest.raises(TrainingDiverged, match="not finite"):
        train(TINY, SCENARIO, tmp_path / "run")
    kept = load_policy(tmp_path / "run" / "policy-last")
    assert all(np.isfinite(tensor).all() for tensor in kept.tensors.values())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": {"harm": 1.0, "shaping": 0.1}}, r"reward.shaping = 0.1: must be 0: a counterfactual is played"),
        ({"counterfactuals": 100}, r"counterfactuals = 100: must be at most n_envs x n_steps = 32"),
        ({"offset": {"smallest": 0.3, "largest": 0.1}}, r"offset.largest = 0.1: must be at least smallest = 0.3"),
        ({"start": "sac@shipped"}, r"start = sac@shipped"),
        ({"n_envs": 2**22}, r"n_envs = 4194304: n_envs x n_steps = 16777216 decisions per update"),
    ],
)
def test_recipe__refuses_what_cannot_be(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        TINY.replace(**changes)


def test_train__beside_a_script_that_remembers(tmp_path: Path) -> None:
    """The moments that the gradients branch from hold what the script remembers."""
    scenario = SCENARIO.replace(
        early_impacts="keep", roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "planner:8"}
    )
    assert train(TINY, scenario, tmp_path / "run").status == "finished"
