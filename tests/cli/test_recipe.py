"""`ethbrake recipe ...`, and `--set` on commands that take a recipe or a scenario."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.evaluation.inputs import load_runnable
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.learning.training import TrainingRecipe, load_recipe, read_settings

Run = Callable[..., Any]


def test_list__has_every_shipped_recipe(ethbrake: Run) -> None:
    answer = ethbrake("recipe", "list")
    assert answer.status == 0 and [line.split()[0] for line in answer.out.splitlines()] == [*TrainingRecipe.shipped()]
    told = json.loads(ethbrake("recipe", "list", "--json").out)
    assert {row["name"]: row["algorithm"] for row in told}["sac"] == "sac"


def test_show_and_validate__read_the_file(ethbrake: Run, tmp_path: Path) -> None:
    assert ethbrake("recipe", "show", "ppo").out == TrainingRecipe.shipped()["ppo"].read_text()
    answer = ethbrake("recipe", "validate", "ppo")
    assert answer.status == 0 and answer.out.startswith("OK  ppo: ppo, 1,500,000 steps, seed 0, ")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(TrainingRecipe.shipped()["ppo"].read_text().replace("gamma: 0.995", "gamma: 2"))
    refused = ethbrake("recipe", "validate", wrong)
    assert refused.status == 2 and "wrong.yaml, line " in refused.err and "gamma = 2" in refused.err
    assert "did you mean 'ppo'" in ethbrake("recipe", "validate", "ppoo").err


@pytest.mark.parametrize("based_on", sorted(TrainingRecipe.shipped()))
def test_new__has_every_key_with_a_comment_and_the_same_values(based_on: str, tmp_path: Path) -> None:
    text = load_recipe(based_on).new_text("mine")
    (tmp_path / "mine.yaml").write_text(text)
    made, base = load_recipe(tmp_path / "mine.yaml"), load_recipe(based_on)
    words = {"name", "title", "description", "source"}
    assert made.model_dump(exclude=words) == base.model_dump(exclude=words)
    lines = text.splitlines()
    for key in type(base).model_fields:
        (number,) = (k for k, line in enumerate(lines) if line.removeprefix("# ").startswith(f"{key}:"))
        assert lines[number - 1].startswith("# "), key


def test_new__writes_a_file_that_validates_and_never_over_another(ethbrake: Run, tmp_path: Path) -> None:
    assert ethbrake("recipe", "new", "mine", "--based-on", "sac", "--output", tmp_path).status == 0
    assert ethbrake("recipe", "validate", tmp_path / "mine.yaml").status == 0
    assert "--force" in ethbrake("recipe", "new", "mine", "--output", tmp_path).err
    assert ethbrake("recipe", "new", "Mine!", "--output", tmp_path).status == 2


def test_settings__are_typed_by_the_rules_of_yaml() -> None:
    texts = ["a=1", "b=0.5", "c=true", "d=x", "e={uniform: [1, 2]}", "f.g.h=null", "i='1'"]
    assert Override.put({}, Override.parse(texts)) == {
        "a": 1, "b": 0.5, "c": True, "d": "x", "e": {"uniform": [1, 2]}, "f": {"g": {"h": None}}, "i": "1",
    }  # fmt: skip


def test_settings__go_into_mappings_and_lists_and_leave_the_rest() -> None:
    content = {"a": {"b": [1, 2], "c": 3}, "d": 4}
    assert Override.put(content, Override.parse(["a.b.1=5", "a.e=6"])) == {"a": {"b": [1, 5], "c": 3, "e": 6}}
    assert content == {"a": {"b": [1, 2], "c": 3}, "d": 4}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("gamma", "must be KEY=VALUE"),
        ("=1", "must be KEY=VALUE"),
        ("a..b=1", "must be KEY=VALUE"),
        ("gama=0.9", "unknown setting 'gama'; did you mean 'gamma'"),
        ("name=x", "unknown setting 'name'"),
        ("recipe.mass_t=1", "unknown setting 'mass_t'"),
        ("gamma=[", "--set gamma, line 1.*not valid YAML"),
    ],
)
def test_settings__what_matches_nothing_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InvalidInput, match=reason):
        read_settings([text], [load_recipe("ppo")])


def test_settings__the_same_key_twice_is_refused() -> None:
    with pytest.raises(InvalidInput, match="--set gamma: is given twice"):
        read_settings(["gamma=0.9", "gamma=0.8"], [load_recipe("ppo")])


def test_settings__belong_to_the_recipe_or_the_scenario() -> None:
    given = read_settings(["gamma=0.9", "scenario.mass_t=40", "recipe.seed=3"], [load_recipe("ppo")])
    assert [each.key for each in given.recipe] == ["gamma", "seed"] and [each.key for each in given.scenario] == [
        "mass_t"
    ]
    with pytest.raises(UnknownName, match="unknown setting 'gamma'"):
        read_settings(["gamma=0.9"])


def test_settings_of_a_recipe__are_checked_and_a_pair_is_kept_together() -> None:
    base, told = load_recipe("ppo"), list[str]()
    changed = read_settings(["learning_rate.start=0.002", "network.policy=[8]"], [base]).change(base)
    assert changed == base.replace(
        learning_rate={**base.learning_rate.model_dump(), "start": 0.002},
        network={**base.network.model_dump(mode="json"), "policy": [8]},
    )
    assert read_settings(["gamma=0.9"], [base]).change(base, told.append).gamma == 0.9
    assert "note: gamma = 0.9, but reward.shaping_discount stays 0.995" in told[0]
    read_settings(["gamma=0.9", "reward.shaping_discount=0.9"], [base]).change(base, told.append)
    assert len(told) == 1
    with pytest.raises(InvalidInput, match=r"reward\.terminl: unknown key; did you mean terminal"):
        read_settings(["reward.terminl=1"], [base]).change(base)
    with pytest.raises(InvalidInput, match=r"--set gamma\.x: there is nothing inside 0\.995"):
        read_settings(["gamma.x=1"], [base]).change(base)


def test_settings_of_a_scenario__are_checked_and_tried() -> None:
    def load(*texts: str) -> Any:
        return load_runnable("paper-random", read_settings(texts).scenario)

    assert load("restitution=0.3").bounds("restitution") == ((0.3, 0.3),)
    assert load("roles.vehicle_3=coast").scripts[2] == "coast" and load("roles.vehicle_3=coast").learners == (1,)
    assert load("gaps_m.uniform.1=12").bounds("gaps_m")[0][1] == 12.0
    assert load("v2x.preset=blocked").v2x.preset == "blocked"
    with pytest.raises(InvalidInput, match="restitution = 3"):
        load("restitution=3")
    with pytest.raises(InvalidInput, match=r"roles\.vehicle_3 = nobody"):
        load("roles.vehicle_3=nobody")
    with pytest.raises(UnknownName, match="did you mean 'mass_t'"):
        load("mass=3")


def test_train__with_settings_trains_by_them_and_notes_them(ethbrake: Run, tiny_recipe: Path, tmp_path: Path) -> None:
    settings = ("--set", "seed=5", "--set", "restitution=0.2")
    answer = ethbrake("train", "--recipe", tiny_recipe, *settings, "--output", tmp_path / "run")
    assert answer.status == 0, answer.err
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["settings"] == ["seed=5", "restitution=0.2"]
    assert config["recipe"]["seed"] == 5 and config["scenario"]["restitution"] == 0.2


def test_evaluate__with_settings_is_about_another_scenario(ethbrake: Run) -> None:
    asked = ("evaluate", "--agents", "coast", "--episodes", "5", "--json")
    (plain,), (changed,) = (json.loads(ethbrake(*asked, *more).out) for more in ((), ("--set", "restitution=0.2")))
    assert changed["parameters"]["restitution"] == 0.2 != plain["parameters"]["restitution"]
    assert changed["scenario_sha256"] != plain["scenario_sha256"]
