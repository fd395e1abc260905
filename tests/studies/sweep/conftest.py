from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.studies import jobs
from tests.learning.tiny import TINY_PPO
from tests.studies.jobs.inside import Inside

RECIPE = {
    **TINY_PPO.model_dump(mode="json"),
    "name": "tiny",
    "total_steps": 256,
    "checkpoint_every_updates": 1,
    "evaluation": {"every_updates": 1, "worlds": 5, "seed": 7},
}


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains for two updates."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    return path


@pytest.fixture
def write_sweep(tmp_path: Path) -> Callable[..., Path]:
    """Writes the file of a sweep."""

    def write(**content: Any) -> Path:
        path = tmp_path / "sweep.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return write


@pytest.fixture(scope="session")
def small(tiny: Path) -> dict[str, Any]:
    """A sweep of four jobs."""
    return {"grid": {"scenario": "paper-random", "recipe": str(tiny), "seed": [3, 5], "set": {"gamma": [0.9, 0.99]}}}


@pytest.fixture(scope="session")
def finished_sweep(tmp_path_factory: pytest.TempPathFactory, small: dict[str, Any]) -> Path:
    """The folder of that sweep, run by this process without a disturbance; not to be changed."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "sweep.yaml").write_text(yaml.safe_dump(small))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "LocalWorkers", Inside)
        assert (
            run_command(["study", "sweep", str(folder / "sweep.yaml"), "--output", str(folder / "out"), "--jobs", "1"])
            == 0
        )
    return folder / "out"
