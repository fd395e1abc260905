"""What makes two trainings the same: content, whatever words, order and spelling it was written in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.training import RunDirectory, Training
from ethbrake_marl.scenario import Scenario, load_scenario
from tests.learning.tiny import TINY_PPO

SCENARIO = load_scenario("paper-random")
TRAINING = Training.of(TINY_PPO, SCENARIO)


def folder_of(path: Path, recipe: dict[str, Any], scenario: dict[str, Any]) -> Path:
    """A run's folder with this configuration."""
    return RunDirectory(path).create({"recipe": recipe, "scenario": scenario}).path


def written(path: Path, **changes: Any) -> Path:
    """A run's folder of ``TINY_PPO`` on a scenario with these keys."""
    recipe = TINY_PPO.model_dump(mode="json")
    return folder_of(path, recipe, SCENARIO.model_dump(mode="json", exclude_unset=True) | changes)


def test_same__words_and_defaults_that_are_spelt_out_change_no_training(tmp_path: Path) -> None:
    words = {"title": "Another", "description": "More.", "source": "Elsewhere."}
    RunDirectory(written(tmp_path / "words", **words)).check_same(TRAINING)
    RunDirectory(written(tmp_path / "defaults", v2x={"preset": "paper"}, speed_limit_mps=40)).check_same(TRAINING)
    assert Training.of(TINY_PPO.replace(**words), SCENARIO.replace(**words)).identity == TRAINING.identity


def test_same__everything_else_does_and_is_named(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    other: list[tuple[Any, Scenario, str]] = [
        (TINY_PPO.replace(seed=1), SCENARIO, "recipe seed"),
        (TINY_PPO.replace(reward={"harm": 2.0}), SCENARIO, "recipe reward"),
        (TINY_PPO, SCENARIO.replace(gaps_m=7), "scenario gaps_m"),
        (TINY_PPO, SCENARIO.replace(v2x="clear", early_impacts="keep"), "scenario early_impacts, scenario v2x"),
        (TINY_PPO, SCENARIO.replace(name="mine"), "scenario name"),
    ]
    for recipe, scenario, named in other:
        with pytest.raises(InvalidInput, match=rf"run: holds another training \(here other: {named}\); give another"):
            RunDirectory(folder).check_same(Training.of(recipe, scenario))
        assert Training.of(recipe, scenario).identity != TRAINING.identity


def test_same__another_library_trains_other_policies(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "library": "benchmarl"}))
    with pytest.raises(InvalidInput, match="was trained by benchmarl"):
        RunDirectory(folder).check_same(TRAINING)


def test_same__a_damaged_configuration_is_named(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "run", {}, {"name": "paper-random"})
    with pytest.raises(InvalidInput, match=r"config.json: .*missing"):
        RunDirectory(folder).check_same(TRAINING)
