"""Recipes of a second, and one finished folder of each study: none of them is to be changed."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.first_edition.learning.tiny import TINY_PPO

from ethbrake_marl.cli.app import run_command
from tests.fixtures.pictures import draw_nothing

RECIPE = {
    **TINY_PPO.model_dump(mode="json"),
    "name": "tiny",
    "total_steps": 256,
    "checkpoint_every_updates": 1,
    "evaluation": {"every_updates": 1, "worlds": 5, "seed": 7},
}


LEVELS = "cooperation-0-sensors,cooperation-3-pair,cooperation-3-congested"


ABLATE = ["--levels", LEVELS, "--seeds", "2", "--episodes", "20", "--search-episodes", "4"]


ABLATE += ["--steps", "128", "--set", "scheme=shared"]


def study(*words: object) -> int:
    """Run ``ethbrake study ...`` in this process; its exit status."""
    return run_command(["study", *map(str, words)])


def write_yaml(path: Path, content: Any) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="session")
def tiny_total(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe for the total harm, with eight decisions in each of eight worlds between two updates."""
    reward = {"harm": 1.0, "harm_count": "total"}
    recipe = TINY_PPO.replace(name="tiny", n_steps=8, n_epochs=1, total_steps=512, reward=reward)
    changes = {"evaluation": {"every_updates": 2, "worlds": 5, "seed": 7}, "checkpoint_every_updates": 1}
    return write_yaml(tmp_path_factory.mktemp("recipe") / "tiny.yaml", {**recipe.model_dump(mode="json"), **changes})


@pytest.fixture(scope="session")
def finished_ablation(tmp_path_factory: pytest.TempPathFactory, tiny_total: Path) -> Path:
    """The folder of a small ablation, with empty pictures."""
    folder = tmp_path_factory.mktemp("ablation") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        assert study("ablate", "--output", folder, "--recipes", tiny_total, *ABLATE) == 0
    return folder
