"""Levels and recipes in a folder of any name."""

import shutil
from pathlib import Path

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.cooperation.levels import plan_ablation
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe


def test_recipes_and_levels__may_lie_in_folders_of_any_name(empty_folder: Path) -> None:
    folder = Path("lr=1,b:2")
    folder.mkdir()
    shutil.copy(TrainingRecipe.shipped()["quick"], folder)
    for level in ("cooperation-1-front", "cooperation-2-paper"):
        shutil.copy(next(each.path for each in eb.list_scenarios() if each.name == level), folder)
    levels = "lr=1,b:2/cooperation-1-front.yaml,lr=1,b:2/cooperation-2-paper.yaml"
    plan = plan_ablation(levels, "lr=1,b:2/quick.yaml,ppo", None, list_seed=7, folder=Path("out"))
    assert [level.name for level in plan.levels] == ["cooperation-1-front", "cooperation-2-paper"]
    assert [recipe.name for recipe in plan.recipes] == ["quick", "ppo"]
