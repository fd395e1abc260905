from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.studies import jobs
from tests.studies.jobs.inside import Inside
from tests.studies.sweep.conftest import RECIPE


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A tuning of trainings of a second: four updates each."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump({**RECIPE, "total_steps": 512}))
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


@pytest.fixture
def write_tuning(tmp_path: Path, small: dict[str, Any]) -> Callable[..., Path]:
    """Writes the file of that tuning, with changes."""

    def write(**changes: Any) -> Path:
        path = tmp_path / "tuning.yaml"
        path.write_text(yaml.safe_dump({key: value for key, value in {**small, **changes}.items() if value != "-"}))
        return path

    return write


TRIALS = 5


@pytest.fixture(scope="session")
def finished_tuning(tmp_path_factory: pytest.TempPathFactory, small: dict[str, Any]) -> Path:
    """The folder of that tuning, done by this process without a disturbance; not to be changed."""
    folder = tmp_path_factory.mktemp("tuning")
    (folder / "tuning.yaml").write_text(yaml.safe_dump(small))
    command = ["study", "tune", str(folder / "tuning.yaml"), "--output", str(folder / "out"), "--trials", str(TRIALS)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "LocalWorkers", Inside)
        assert run_command([*command, "--export", str(folder / "best.yaml")]) == 0
    return folder / "out"
