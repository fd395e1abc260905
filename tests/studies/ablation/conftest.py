from __future__ import annotations

from pathlib import Path

import pytest
import yaml

RECIPE = {
    "name": "tiny",
    "algorithm": "ppo",
    "total_steps": 512,
    "n_envs": 8,
    "n_steps": 8,
    "batch_size": 64,
    "n_epochs": 1,
    "learning_rate": {"start": 3e-4, "end": 3e-5},
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "network": {"policy": [8], "value": [8]},
    "reward": {"harm": 1.0, "harm_count": "total"},
    "seed": 0,
    "evaluation": {"every_updates": 2, "worlds": 5, "seed": 7},
    "checkpoint_every_updates": 1,
}


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains for a few updates."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    return path
