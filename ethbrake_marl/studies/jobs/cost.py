"""The cost of a training on this machine, measured by a short one."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.team_file import load_team
from ethbrake_marl.learning.train import train
from ethbrake_marl.progress import Progress
from ethbrake_marl.scenario import Sample, Scenario

_UPDATES = 4  # of the training that is timed; the first one, which compiles and warms up, does not count


@dataclass(frozen=True, slots=True)
class Timed:
    """Seconds of one core, by the clock."""

    decision_s: float  # of a learner, its share of the learning included
    world_s: float  # that the policy drives


def time_training(recipe: TrainingRecipe, scenario: Scenario, sample: Sample) -> Timed:
    """Time a few updates of a training, and its policy on the worlds of ``sample``."""
    told: list[Progress] = []
    short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        path = Path(folder) / "timed"
        train(short, scenario, path, steps=1, on_progress=told.append)
        once = told[-1].done  # decisions of one update
        told.clear()
        train(short, scenario, path, steps=_UPDATES * once, force=True, on_progress=told.append)
        return Timed(_per_step(told), world_seconds(path, scenario, sample))


def training_seconds(recipe: TrainingRecipe, scenario: Scenario, timed: Timed, steps: int) -> float:
    """Seconds of ``steps`` decisions, of as many trainings as they make, with what is measured on the way."""
    measured = _measurements(recipe, len(scenario.learners)) * recipe.evaluation.worlds
    return steps * timed.decision_s + steps / recipe.total_steps * measured * timed.world_s


def world_seconds(folder: Path, scenario: Scenario, sample: Sample) -> float:
    """Seconds per world that a trained team drives."""
    team = load_team(folder, scenario)
    evaluate(sample.worlds.take(np.arange(min(5, sample.worlds.n))), {"warm": team}, scenario=scenario, aftermath=False)
    started = time.monotonic()
    evaluate(sample, {"team": team}, scenario=scenario, aftermath=False)
    return (time.monotonic() - started) / sample.worlds.n


def told_seconds(seconds: float) -> str:
    """Seconds, minutes or hours, in words."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"


def _per_step(told: Sequence[Progress]) -> float:
    """Seconds per decision between the first and the last update that was told."""
    updates = [one for one in told if one.updates >= 1]
    first, last = updates[0], updates[-1]
    if last.done == first.done:
        return last.wall_s / last.done
    return (last.wall_s - first.wall_s) / (last.done - first.done)


def _measurements(recipe: TrainingRecipe, learners: int) -> int:
    """How often a training measures its policies on the fixed list: at first, now and then, and at the end."""
    per_update = recipe.n_envs * learners * recipe.rounds
    return recipe.total_steps // per_update // recipe.evaluation.every_updates + 2
