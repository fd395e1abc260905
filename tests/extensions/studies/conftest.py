"""Recipes of a second, and one finished folder of each study: none of them is to be changed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from ethbrake_marl.cli.app import run_command
from tests.fixtures.pictures import draw_nothing
from tests.learning.tiny import TINY_PPO

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


TRIALS = 5


Write = Callable[..., Path]


def study(*words: object) -> int:
    """Run ``ethbrake study ...`` in this process; its exit status."""
    return run_command(["study", *map(str, words)])


def write_yaml(path: Path, content: Any) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains for two updates."""
    return write_yaml(tmp_path_factory.mktemp("recipe") / "tiny.yaml", RECIPE)


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


@pytest.fixture(scope="session")
def small_sweep(tiny: Path) -> dict[str, Any]:
    """A sweep of four jobs."""
    return {"grid": {"scenario": "paper-random", "recipe": str(tiny), "seed": [3, 5], "set": {"gamma": [0.9, 0.99]}}}


@pytest.fixture(scope="session")
def finished_sweep(tmp_path_factory: pytest.TempPathFactory, small_sweep: dict[str, Any]) -> Path:
    """The folder of that sweep."""
    pytest.importorskip("ray")
    file = write_yaml(tmp_path_factory.mktemp("sweep") / "sweep.yaml", small_sweep)
    assert study("sweep", file, "--output", file.parent / "out", "--jobs", "1") == 0
    return file.parent / "out"


@pytest.fixture(scope="session")
def small_tuning(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A tuning of trainings of a second: four updates each."""
    path = write_yaml(tmp_path_factory.mktemp("recipe") / "tiny.yaml", {**RECIPE, "total_steps": 512})
    return {
        "scenario": "paper-random",
        "recipe": str(path),
        "search": {
            "learning_rate.start": {"low": 1e-4, "high": 1e-1, "log": True},
            "n_epochs": {"low": 1, "high": 4},
            "network.policy": {"choices": [[8], [16, 8]]},
        },
        "measure": {"worlds": 10, "seed": 11, "times": 4},
        "prune": {"after_trials": 2, "after_times": 1},
        "sampler": {"random_trials": 3},
    }


@pytest.fixture(scope="session")
def finished_tuning(tmp_path_factory: pytest.TempPathFactory, small_tuning: dict[str, Any]) -> Path:
    """The folder of that tuning; its best recipe stands beside it."""
    pytest.importorskip("ray")
    file = write_yaml(tmp_path_factory.mktemp("tuning") / "tuning.yaml", small_tuning)
    words = ("--output", file.parent / "out", "--trials", TRIALS, "--export", file.parent / "best.yaml")
    assert study("tune", file, *words) == 0
    return file.parent / "out"


@pytest.fixture
def write_sweep(tmp_path: Path) -> Write:
    """Writes the file of a sweep."""
    return lambda **content: write_yaml(tmp_path / "sweep.yaml", content)


@pytest.fixture
def write_tuning(tmp_path: Path, small_tuning: dict[str, Any]) -> Write:
    """Writes the file of the small tuning, with changes."""
    return lambda **changes: write_yaml(tmp_path / "tuning.yaml", {**small_tuning, **changes})
