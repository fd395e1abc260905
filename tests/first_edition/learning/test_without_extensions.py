"""Training where no extension is installed: PPO and SAC, and a clear word for every other algorithm."""

import json
from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.train import quickest
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.first_edition.training.experiment import run_experiment
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, algorithm_names, load_recipe
from tests.first_edition.learning.tiny import TINY_PPO

TINY = TINY_PPO.replace(total_steps=256)


pytestmark = pytest.mark.usefixtures("core_alone")


def test_algorithm__of_an_absent_extension_is_refused_by_name() -> None:
    assert algorithm_names() == ("ppo", "sac")
    with pytest.raises(InvalidInput) as error:
        load_recipe("vine")
    told = "vine.yaml, line 11: algorithm = vine: must be one of ppo, sac"
    assert f"{told}; this algorithm belongs to the extension learners, which is not installed" in str(error.value)
    with pytest.raises(
        InvalidInput, match=r"recipe 'ppo': algorithm = rollout-classification: must be one of ppo, sac$"
    ):
        TINY.replace(algorithm="rollout-classification")


def test_recipes__that_are_listed_can_be_used_and_run_takes_the_first_of_them() -> None:
    assert TrainingRecipe.usable().keys() < TrainingRecipe.shipped().keys()
    assert {load_recipe(name).algorithm for name in TrainingRecipe.usable()} == {"ppo", "sac"}
    assert quickest() == "ppo"
    with pytest.raises(UnknownName, match=r"^unknown recipe 'quik'; known: cooperation-ppo, ppo, ppo-paper, sac"):
        load_recipe("quik")


def test_run__without_a_report_trains_shields_evaluates_and_writes_results(tmp_path: Path) -> None:
    result = run_experiment(eb.load_scenario("paper-random"), tmp_path / "run", recipe=TINY, episodes=20)
    rows = json.loads((tmp_path / "run" / "results.json").read_text())
    assert rows == result.results and [row["agent"] for row in rows][-2:] == ["trained policy", "hybrid"]
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"policy", "results.csv", "per_world.csv"}
    assert not {"report.html", "other_tests.json"} & {path.name for path in (tmp_path / "run").iterdir()}
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "finished"
    assert len(result.tables) > 0 and result.notes == (f"results, with every measure: {tmp_path}/run/results.json",)
