"""Several learners: who learns from whose rows, and who sees what."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import make_agent, open_game, team_of
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.training import train as train_module
from ethbrake_marl.training.recipe import algorithm_of
from ethbrake_marl.training.train import make_environment, train
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.refused import refused
from tests.training.tiny import PAIR, TINY, UPDATE, begin, dying_after, go_on, kept, killed

NAMES = ("vehicle_2", "vehicle_3")
SHORT = TINY.replace(total_steps=2 * 2 * UPDATE)


@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_train__leaves_policies_that_drive_as_they_were_measured(scheme: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    result = train(SHORT, PAIR, run, scheme=scheme, on_progress=None)
    assert (result.status, result.updates, result.training.scheme) == ("finished", 2, scheme)
    separate = scheme == "independent"
    assert result.agent == f"team@{run}"
    scenario, game = open_game(PAIR)
    last = play_to_end(game, scenario.sample(10, 7), team_of(make_agent(result.agent, scenario=PAIR), scenario))
    least = min(each["first_impact_harm"] for each in result.evaluations)
    assert last.harm("first").mean() == pytest.approx(least, rel=1e-12)
    manifests = [load_policy(run / place).manifest for place in result.training.drivers.values()]
    assert [each.learners for each in manifests] == [(name,) if separate else NAMES for name in NAMES]
    assert [bool(each.network.value_hidden) for each in manifests] == [scheme != "centralised"] * 2
    assert len({each.weights_sha256 for each in manifests}) == 1 + separate
    if separate:
        with refused("vehicle_2, vehicle_3 have different policies; use the attribute"):
            _ = result.policy
    else:
        assert result.policy is result.policies["vehicle_3"]


def test_train__other_vehicles_are_driven_by_the_agents_that_roles_name(tmp_path: Path) -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm"}
    scenario = load_scenario("paper-random").replace(roles=roles, early_impacts="keep")
    whole = train(TINY, scenario, tmp_path / "whole", on_progress=None)
    braking = begin("ppo", tmp_path / "other", steps=UPDATE)
    assert whole.evaluations[0]["first_impact_harm"] != braking.evaluations[0]["first_impact_harm"]
    killed(train, TINY, scenario, tmp_path / "run", on_progress=dying_after(3))
    go_on(tmp_path / "run")
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")


def history(folder: Path) -> list[dict[str, str]]:
    """Hashes of the weights of two independent learners before the first update and after each one."""
    seen: list[dict[str, str]] = []

    def note(policies: Any) -> dict[str, float]:
        seen.append({name: policy.manifest.weights_sha256 for name, policy in policies.items()})
        return {}

    recipe = SHORT.replace(scheme="independent", evaluation={"every_updates": 1, "worlds": 1, "seed": 7})
    train(recipe, PAIR, folder, measure=lambda training: note, on_progress=None)
    return seen


def test_independent__each_learns_from_its_own_rewards_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Spoiled(train_module.EthBrakeVecEnv):
        def step_wait(self) -> Any:
            answer = super().step_wait()
            answer[1][1::2] *= 3.0  # rows of vehicle_3
            return answer

    before, plain = history(tmp_path / "plain")[:2]
    monkeypatch.setattr(train_module, "EthBrakeVecEnv", Spoiled)
    spoiled = history(tmp_path / "spoiled")[1]
    assert [before[name] == plain[name] for name in NAMES] == [False, False]
    assert [plain[name] == spoiled[name] for name in NAMES] == [True, False]


def model_of(scheme: str) -> tuple[Any, Any]:
    """Policy in training, and its environment."""
    training = Training.of(SHORT, PAIR, scheme=scheme)
    environment = make_environment(training)
    return algorithm_of(training.recipe).build(training, environment).policy, environment


def test_independent__a_row_is_valued_by_its_own_learner() -> None:
    policy, environment = model_of("independent")
    seen = environment.reset()
    assert seen[:, -1].tolist() == [0.0, 1.0] * 8
    tensor = policy.obs_to_tensor(seen)[0]
    values = policy.predict_values(tensor)[:, 0]
    for number, member in enumerate(policy.policies):
        own = member.predict_values(tensor[number::2, :-1])[:, 0]
        np.testing.assert_allclose(values[number::2].detach().numpy(), own.detach().numpy(), atol=1e-6)
    alone = policy.predict_values(policy.obs_to_tensor(seen[1])[0])
    assert alone.item() == pytest.approx(values[1].item(), abs=1e-6)


def test_independent__learners_may_observe_different_features(tmp_path: Path) -> None:
    scenario = load_scenario(PAIR).replace(
        observation={"vehicle_2": ["own", "front_1"], "vehicle_3": ["front_1.gap", "own"]}
    )
    with refused("scheme shared: vehicle_2, vehicle_3 share a policy, but observe different features"):
        Training.of(SHORT, scenario, scheme="shared")
    assert Training.of(SHORT.replace(observation=["own"]), scenario).scheme == "shared"
    result = train(SHORT, scenario, tmp_path / "run", scheme="independent", on_progress=None)
    training = result.training
    assert [len(each) for each in training.columns] == [17, 8]
    assert [training.row.names[column] for column in training.columns[1]] == list(training.views[1].names)
    observed = [policy.manifest.observation.features for policy in result.policies.values()]
    assert observed == [view.names for view in training.views]


def test_centralised__the_critic_sees_the_line_and_the_actor_does_not() -> None:
    policy, environment = model_of("centralised")
    seen = environment.reset()
    own = len(environment.game.views[2].names)
    other = seen.copy()
    other[:, own:] += 0.5
    first, second = (policy.obs_to_tensor(each)[0] for each in (seen, other))
    assert (policy._predict(first, deterministic=True) == policy._predict(second, deterministic=True)).all()
    assert (policy.predict_values(first) != policy.predict_values(second)).any()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_scheme__learns_to_beat_full_braking(scheme: Any, tmp_path: Path) -> None:
    reward = {**TINY.reward.model_dump(), "harm_count": "first"}
    recipe = TINY.replace(
        n_envs=32, n_steps=32, batch_size=256, network={"policy": [32, 32], "value": [32, 32]}, reward=reward
    )
    result = train(recipe, PAIR, tmp_path / "run", scheme=scheme, steps=60_000, on_progress=None)
    assert result.metrics is not None
    assert result.metrics["first_impact_harm"] < 0.8 * result.evaluations[0]["first_impact_harm"]
