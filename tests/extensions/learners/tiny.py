"""Trainings of a second by vine, and models that have not learned yet."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger

from ethbrake_marl.training.recipe import algorithm_of, load_recipe
from ethbrake_marl.training.train import make_environment
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.catalogue import load_scenario

PAPER = load_scenario("paper-random")
PAIR = PAPER.with_learners(["vehicle_2", "vehicle_3"])
OWN = {"harm": 1.0, "harm_count": "total", "objective": "own", "terminal": 0.5}

SHORT = {
    "observation": None, "n_envs": 8, "n_steps": 4, "tried": 16, "batch_size": 8, "total_steps": 256,
    "averaging": 0.9, "learning_rate": {"start": 1e-2, "end": 1e-3},
    "evaluation": {"every_updates": 4, "worlds": 10, "seed": 7}, "checkpoint_every_updates": 1,
}  # fmt: skip
VINE = load_recipe("vine").replace(start=None, network={"policy": [8]}, reward={"harm": 1.0}, **SHORT)


def new_model(recipe: Any, scenario: Any = PAPER) -> Any:
    training = Training.of(recipe, scenario)
    model = algorithm_of(recipe).build(training, make_environment(training))
    model.set_logger(Logger(None, []))
    model._last_obs = model.rows.reset()
    return model


def fingerprint(policies: Any) -> list[float]:
    """Sum of the absolute weights of each learned tensor of the first policy."""
    tensors = next(iter(policies.values())).tensors
    learned = sorted(name for name in tensors if "log_std" not in name)
    return [float(np.abs(tensors[name].astype(np.float64)).sum()) for name in learned]
