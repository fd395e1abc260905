"""Which recipes train which networks; schemes: who learns with whom, what is left of it, and that each learns."""

import json
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.files.yaml import parse_yaml, read_yaml
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.network_spec import NetworkSpec
from ethbrake_marl.first_edition.policies.teams import PolicyTeam
from ethbrake_marl.first_edition.scenario.catalogue import shipped_folder
from ethbrake_marl.first_edition.training.models import make_model
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.session import train
from ethbrake_marl.first_edition.training.team import has_policy_each, load_team
from ethbrake_marl.first_edition.training.training import Training, check_same_training
from tests.first_edition.learning.tiny import TINY_PPO, Answer, harm_beside_full_braking, marked, watch_steps

PAIR = eb.load_scenario("cooperation-3-pair")
NAMES = ("vehicle_2", "vehicle_3")
TINY = TINY_PPO.replace(total_steps=4 * 256)


@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_train__leaves_a_folder_that_drives_by_itself(scheme: Any, tmp_path: Path) -> None:
    result = train(TINY, PAIR, tmp_path / "run", scheme=scheme)
    assert (result.status, result.steps, result.updates, result.training.scheme) == ("finished", 4 * 256, 4, scheme)
    assert [entry["updates"] for entry in result.evaluations] == [0, 3, 4]
    separate = scheme == "independent"
    given = {name: f"policy/{name}" if separate else "policy" for name in NAMES}
    content = json.loads((tmp_path / "run" / "team.json").read_text())
    assert (content["scheme"], content["vehicles"], content["drivers"]) == (scheme, 3, given)
    assert result.training.drivers == given and has_policy_each(RunDirectory(tmp_path / "run")) == separate
    moved = Path(shutil.move(tmp_path / "run", tmp_path / "elsewhere"))
    team = load_team(moved, PAIR)
    assert sorted(team.drivers) == [1, 2]
    harm = eb.evaluate(PAIR.sample(10, 7), {"team": team}, scenario=PAIR).outcome("team").first_impact_harm.mean()
    assert harm == pytest.approx(min(entry["first_impact_harm"] for entry in result.evaluations))
    manifests = [load_policy(moved / given[name]).manifest for name in NAMES]
    told = [(each.learners, bool(each.network.value_hidden)) for each in manifests]
    assert told == [((name,) if separate else NAMES, scheme != "centralised") for name in NAMES]
    assert len({each.weights_sha256 for each in manifests}) == (2 if separate else 1)


def history(recipe: TrainingRecipe, folder: Path) -> list[dict[str, str]]:
    """Hashes of the learners' weights before the first update and after each one."""
    seen: list[dict[str, str]] = []

    def note(team: PolicyTeam) -> dict[str, float]:
        seen.append({name: policy.manifest.weights_sha256 for name, policy in team.drivers.items()})
        return {}

    often = recipe.replace(evaluation={"every_updates": 1, "worlds": 1, "seed": 7})
    train(often, PAIR, folder, measure=lambda training: note)
    return seen


@pytest.mark.parametrize(
    ("changes", "who"),
    [({"total_steps": 2 * 256}, [(0, 1)] * 2), ({"turns": 2, "total_steps": 8 * 256}, [(0,), (0,), (1,), (1,)] * 2)],
)
def test_independent__all_learn_at_once_or_in_turns(
    changes: dict[str, int], who: list[tuple[int, ...]], tmp_path: Path
) -> None:
    steps = pairwise(history(TINY.replace(scheme="independent", **changes), tmp_path / "run")[: len(who) + 1])
    assert [[n for n in NAMES if a[n] != b[n]] for a, b in steps] == [[NAMES[k] for k in each] for each in who]


def test_independent__nobody_learns_from_anothers_reward(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(step: int, answer: Answer) -> Answer:
        answer[1][1::2] *= 3.0  # rows of vehicle_3
        return answer

    recipe = TINY.replace(scheme="independent", total_steps=256)
    plain = history(recipe, tmp_path / "plain")[1]
    watch_steps(monkeypatch, spoil)
    spoiled = history(recipe, tmp_path / "spoiled")[1]
    assert [plain[name] == spoiled[name] for name in NAMES] == [True, False]


def model_of(scheme: str, appended: Any) -> tuple[Any, eb.EthBrakeVecEnv]:
    """The policy in training, and its environment."""
    recipe = TINY.replace(scheme=scheme)
    environment = eb.make_sb3_vec_env(PAIR, 8, appended=appended, reward=recipe.reward)
    return make_model(recipe.make_algorithm(), Training.of(recipe, PAIR), environment).policy, environment


def test_independent__a_row_that_is_cut_off_gets_the_value_of_its_own_learner() -> None:
    policy, environment = model_of("independent", "number")
    seen = environment.reset()
    assert seen.shape == (16, environment.engine.observation.size + 1)
    assert seen[:, -1].tolist() == [0.0, 1.0] * 8
    tensor = policy.obs_to_tensor(seen)[0]
    values = policy.predict_values(tensor)[:, 0]
    for number, member in enumerate(policy.policies):
        own = member.predict_values(tensor[number::2, :-1])[:, 0]
        np.testing.assert_allclose(values[number::2].detach().numpy(), own.detach().numpy(), atol=1e-6)
    alone = policy.predict_values(policy.obs_to_tensor(seen[1])[0])
    assert alone.item() == pytest.approx(values[1].item(), abs=1e-6)


def test_centralised__the_critic_sees_the_line_and_the_actor_does_not() -> None:
    policy, environment = model_of("centralised", "state")
    seen = policy.obs_to_tensor(environment.reset())[0]
    elsewhere = seen.clone()
    elsewhere[:, environment.engine.observation.size :] += 0.1
    actions = [policy.get_distribution(each).distribution.mean for each in (seen, elsewhere)]
    assert (actions[0] == actions[1]).all()
    assert (policy.predict_values(seen) != policy.predict_values(elsewhere)).all()


LEARNS = load_recipe("cooperation-ppo").replace(
    total_steps=200_000,
    n_envs=32,
    network={"policy": [64, 64], "value": [64, 64], "initial_log_std": -0.7},
    evaluation={"every_updates": 1000, "worlds": 1000, "seed": 1007},
)


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["shared", "independent", "centralised"])
def test_scheme__learns_to_beat_full_braking(scheme: Any, tmp_path: Path) -> None:
    train(LEARNS, PAIR, tmp_path / "run", scheme=scheme)
    assert harm_beside_full_braking(f"team@{tmp_path / 'run'}") < 0.9


# ---------------------------------------------------------------- recipes


SHIPPED = TrainingRecipe.shipped()
PAPERS = {
    "ppo-paper": {
        "gamma": 0.99, "n_steps": 2048, "n_epochs": 4, "batch_size": 512, "clip_range": 0.15, "gae_lambda": 0.95,
        "vf_coef": 0.5, "ent_coef": 0.005, "target_kl": 0.15, "max_grad_norm": 0.3,
    },
    "sac-paper": {
        "batch_size": 256, "buffer_size": 10**6, "learning_starts": 10**4, "tau": 0.02, "gamma": 0.99,
        "steps_per_update": 1, "gradient_steps": 1, "ent_coef": "auto", "target_update_interval": 1, "n_envs": 1,
        "update_ratio": 1.0,
    },
}  # fmt: skip
NETWORKS = {
    "ppo-paper": {"value_hidden": (256, 256, 128), "output": "clip"},
    "sac-paper": {"value_hidden": (), "output": "tanh"},
}


@pytest.mark.parametrize(("name", "value"), [("ppo-paper", (256, 256, 128)), ("sac-paper", (256, 256))])
def test_recipe__of_the_paper_has_its_network_and_table(name: str, value: tuple[int, ...]) -> None:
    recipe = load_recipe(name)
    assert {key: getattr(recipe, key) for key in PAPERS[name]} == PAPERS[name] and recipe.network.value == value
    shape = {"observation_size": 27, "action_size": 1, "policy_hidden": (256, 256), "activation": "relu"}
    assert recipe.network_spec(27) == NetworkSpec(**shape, **NETWORKS[name])


@pytest.mark.parametrize("name", [name for name, file in SHIPPED.items() if file.parent == shipped_folder("train")])
def test_recipe__that_ships_comes_back_from_its_json_and_its_template_and_passes_the_schema(name: str) -> None:
    check_shipped(name)


def check_shipped(name: str) -> None:
    recipe, new = load_recipe(name), parse_yaml(load_recipe(name).new_text("mine"), "mine.yaml").content
    assert TrainingRecipe.of(recipe.model_dump(mode="json")) == recipe
    assert TrainingRecipe.of(new).name == "mine"
    schema = TrainingRecipe.json_schema()
    assert marked(schema, read_yaml(SHIPPED[name]).content) == marked(schema, new) == set()
    # nothing is expected beyond the horizon; those whose policy ships, or was measured, without it say so
    assert recipe.horizon_is_end == (name not in ("ppo-paper", "sac-paper", "sac-long"))
    assert "horizon_is_end" in recipe.model_fields_set


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_schema__says_what_every_key_of_an_algorithm_means(algorithm: str) -> None:
    check_meanings(algorithm)


def check_meanings(algorithm: str) -> None:
    recipe = type(load_recipe(algorithm))
    properties = TrainingRecipe.json_schema()["$defs"][recipe.__name__]["properties"]
    assert set(properties) == set(recipe.model_fields)
    assert [key for key, value in properties.items() if not value.get("description")] == []


SCENARIO = eb.load_scenario("paper-random")
TRAINING = Training.of(TINY_PPO, SCENARIO)
WORDS = {"title": "Another", "description": "More.", "source": "Elsewhere."}


@pytest.mark.parametrize("change", [WORDS, {"v2x": {"preset": "paper"}, "speed_limit_mps": 40}])
def test_training__words_and_defaults_that_are_spelt_out_change_nothing(change: dict[str, Any], tmp_path: Path) -> None:
    scenario = SCENARIO.model_dump(mode="json", exclude_unset=True) | change
    config = {"recipe": TINY_PPO.model_dump(mode="json"), "scenario": scenario}
    check_same_training(RunDirectory(tmp_path / "run").create(config), TRAINING)
    assert Training.of(TINY_PPO.replace(**WORDS), SCENARIO.replace(**WORDS)).identity == TRAINING.identity


def test_run__force_replaces_a_run_and_all_that_it_held(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "runs" / "first").create({"seeds": {"training": 3}})
    assert json.loads(run.config.read_text()) == {"seeds": {"training": 3}}
    assert json.loads(run.status.read_text())["status"] == "running"
    (run.path / "old").touch()
    again = RunDirectory(run.path).create({}, force=True).path
    assert sorted(path.name for path in again.iterdir()) == ["config.json", "run.json"]
    assert [path.name for path in run.path.parent.iterdir()] == ["first"]
