"""Trainings that were interrupted, to be changed and resumed."""

from __future__ import annotations

import atexit
import functools
import hashlib
import json
import shutil
import signal
import tempfile
from pathlib import Path
from typing import Any

from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.scenario import load_scenario

RUN = "run"
SMALL: dict[str, Any] = {
    "n_envs": 4,
    "batch_size": 16,
    "network": {"policy": [4], "value": [4]},
    "evaluation": {"every_updates": 2, "worlds": 2, "seed": 7},
}
PPO = {**SMALL, "n_steps": 8, "n_epochs": 1, "total_steps": 256, "checkpoint_every_updates": 2}
SAC = {
    **SMALL,
    "buffer_size": 64,
    "learning_starts": 8,
    "total_steps": 64,
    "checkpoint_every_updates": 4,
    "log_every_updates": 2,
}


@functools.cache
def stopped(algorithm: str) -> Path:
    """A training that was interrupted, with its checkpoints; it goes on for a few updates."""
    folder = Path(tempfile.mkdtemp(prefix="hostile-runs-")) / RUN
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    seen = []

    def measure(policy: object) -> dict[str, float]:
        seen.append(policy)
        if len(seen) == 4:
            signal.raise_signal(signal.SIGINT)
        return {"first_impact_harm": 1.0, "total_harm": 1.0}

    settings = PPO if algorithm == "ppo" else SAC
    recipe = load_recipe(algorithm).replace(**settings)
    train(recipe, load_scenario("paper-random"), folder, measure=lambda training: measure)
    assert json.loads((folder / "run.json").read_text())["status"] == "interrupted"
    return folder


def newest(run: Path) -> Path:
    """The newest checkpoint."""
    return max(run.glob("checkpoints/step_*"))


def listed_anew(checkpoint: Path) -> None:
    """Let the listing agree with what is there."""
    path = checkpoint / "checkpoint.json"
    listing = json.loads(path.read_text())
    files = [file for file in checkpoint.rglob("*") if file.is_file() and file != path]
    listing["files"] = {
        file.relative_to(checkpoint).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in files
    }
    path.write_text(json.dumps(listing))
