from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.learning.training import LearningRate, SacRecipe, TrainingRecipe, load_recipe
from ethbrake_marl.policies import NetworkSpec

GOOD = """\
name: mine
algorithm: ppo
total_steps: 4096
n_envs: 16
n_steps: 32
batch_size: 128
n_epochs: 2
learning_rate: {start: 1e-3, end: 1e-4}
gamma: 0.99
gae_lambda: 0.95
clip_range: 0.2
ent_coef: 0
vf_coef: 0.5
max_grad_norm: 0.5
network: {policy: [8], value: [8, 4]}
reward: {harm: 1}
evaluation: {every_updates: 2, worlds: 10, seed: 7}
checkpoint_every_updates: 3
"""


def _write(folder: Path, old: str = "", new: str = "") -> Path:
    assert old in GOOD
    path = folder / "mine.yaml"
    path.write_text(GOOD.replace(old, new, 1))
    return path


def test_load_recipe__reads_a_file(tmp_path: Path) -> None:
    recipe = load_recipe(_write(tmp_path))
    assert (recipe.n_envs, recipe.n_steps, recipe.network.value) == (16, 32, (8, 4))
    assert recipe.target_kl is None
    assert recipe.reward.harm_count == "first"


def test_load_recipe__the_papers_network() -> None:
    recipe = load_recipe("ppo-paper")
    assert recipe.name == "ppo-paper"
    assert recipe.network_spec(27) == NetworkSpec(
        observation_size=27,
        action_size=1,
        policy_hidden=(256, 256),
        value_hidden=(256, 256, 128),
        activation="relu",
        output="clip",
    )


def test_load_recipe__the_papers_table() -> None:
    r = load_recipe("ppo-paper")
    assert (r.gamma, r.n_steps, r.n_epochs, r.batch_size, r.clip_range) == (0.99, 2048, 4, 512, 0.15)
    assert (r.gae_lambda, r.vf_coef, r.ent_coef, r.target_kl, r.max_grad_norm) == (0.95, 0.5, 0.005, 0.15, 0.3)


def test_load_recipe__the_papers_table_of_sac() -> None:
    r = load_recipe("sac-paper")
    assert isinstance(r, SacRecipe)
    assert (r.batch_size, r.buffer_size, r.learning_starts, r.tau, r.gamma) == (256, 10**6, 10**4, 0.02, 0.99)
    assert (r.steps_per_update, r.gradient_steps, r.ent_coef, r.target_update_interval) == (1, 1, "auto", 1)
    assert (r.network.policy, r.network.value, r.network.activation) == ((256, 256), (256, 256), "relu")
    assert (r.n_envs, r.update_ratio) == (1, 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ent_coef": "automatic"}, r"ent_coef = automatic: must be auto or a number of at least 0"),
        ({"ent_coef": -1}, r"ent_coef = -1: must be auto or a number of at least 0"),
        ({"buffer_size": 63}, r"buffer_size = 63: must be at least n_envs = 128"),
        ({"n_steps": 3}, r"n_steps: unknown key"),
        ({"tau": 0.0}, r"tau = 0.*: must be greater than 0"),
        ({"algorithm": "td3"}, r"algorithm = td3: must be ppo or sac or counterfactual"),
    ],
)
def test_sac_recipe__refuses_bad_input(change: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=f"recipe 'sac': {message}"):
        load_recipe("sac").replace(**change)


def test_recipe__comes_back_from_its_json() -> None:
    for name in TrainingRecipe.shipped():
        recipe = load_recipe(name)
        assert TrainingRecipe.of(recipe.model_dump(mode="json")) == recipe


def test_shipped_recipes__are_found_by_name() -> None:
    assert {"ppo", "ppo-paper"} <= TrainingRecipe.shipped().keys()
    with pytest.raises(UnknownName, match="unknown recipe 'ppo-papre'; did you mean 'ppo-paper'"):
        load_recipe("ppo-papre")


def test_shipped_recipes__of_ppo_expect_nothing_beyond_the_horizon() -> None:
    recipes = [load_recipe(name) for name in TrainingRecipe.shipped()]
    without = [each.name for each in recipes if each.algorithm == "ppo" and not each.horizon_is_end]
    assert without == ["ppo-paper"]  # whose values are the paper's


def test_learning_rate__cosine_by_hand() -> None:
    rate = LearningRate(start=5e-4, end=1e-4)
    assert [rate.at(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([5e-4, 3e-4, 1e-4])
    assert rate.at(0.75) == pytest.approx(1e-4 + 4e-4 * (1.0 + 0.5**0.5) / 2.0)
    assert rate.at(-0.1) == pytest.approx(1e-4)  # the last rollout may overshoot the end; the rate must not rise again


def test_replace__is_checked_again() -> None:
    recipe = load_recipe("ppo")
    assert recipe.replace(seed=5, total_steps=10).seed == 5
    with pytest.raises(InvalidInput, match=r"recipe 'ppo': seed = -1: must be greater than or equal to 0"):
        recipe.replace(seed=-1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("n_envs: 16", "n_env: 16", r"mine.yaml, line 4: n_env: unknown key; did you mean n_envs"),
        ("policy: [8]", "policies: [8]", r"line 15: network.policies: unknown key; did you mean policy"),
        ("harm: 1", "speed: 1", r"line 16: reward.speed: unknown key; known: harm, harm_count"),
        ("gamma: 0.99\n", "", r"mine.yaml: gamma: missing; it is needed"),
        ("gamma: 0.99", "gamma: .nan", r"line 9: gamma = .nan: must be"),
        ("gamma: 0.99", "gamma: 1.5", r"line 9: gamma = 1.5: must be less than or equal to 1"),
        ("algorithm: ppo", "algorithm: trpo", r"line 2: algorithm = trpo: must be ppo or sac"),
        ("total_steps: 4096", "total_steps: many", r"line 3: total_steps = many: must be a whole number"),
        (
            "total_steps: 4096",
            "total_steps: 1e6",
            r"line 3: total_steps = 1000000.0: must be a whole number, written without a decimal",
        ),
        ("start: 1e-3", "start: -1e-3", r"line 8: learning_rate.start = -0.001: must be greater than 0"),
        ("batch_size: 128", "batch_size: 100", r"line 6: batch_size = 100: must divide n_envs x n_steps = 512"),
        (
            "n_envs: 16",
            "n_envs: 100000000",
            r"line 4: n_envs = 100000000: n_envs x n_steps = 3200000000 decisions per update; at most 16777216",
        ),
        ("policy: [8]", "policy: []", r"line 15: network.policy = \[\]"),
        ("policy: [8]", 'policy: ["8"]', r"line 15: network.policy\[0\] = .8.: must be a whole number"),
        ("policy: [8]", "policy: [1000000]", r"network.policy\[0\] = 1000000: must be less than or equal to 4096"),
        ("harm: 1", "harm: 0", r"line 16: reward = .*harm: 0.*: every weight is 0"),
        ("harm: 1", "harm: -1", r"line 16: reward.harm = -1"),
        ("every_updates: 2", "every_updates: 0", r"line 17: evaluation.every_updates = 0"),
        ("name: mine", "name: ../mine", r"line 1: name = .*../mine.*: must be 1 to 64 lower case letters"),
        ("{start: 1e-3, end: 1e-4}", "3e-4", r"line 8: learning_rate = 0.0003: must be a mapping$"),
        ("name: mine", "name: [mine", r"mine.yaml, line 2.*: not valid YAML"),
        (GOOD, "- ppo\n", r"mine.yaml: must be a mapping"),
    ],
)
def test_load_recipe__refuses_bad_input(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=message) as caught:
        load_recipe(_write(tmp_path, old, new))
    assert "\n" not in str(caught.value)
