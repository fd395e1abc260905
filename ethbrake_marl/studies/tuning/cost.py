"""The cost of a trial on this machine, told before anything is begun."""

from __future__ import annotations

from ethbrake_marl.studies.jobs.cost import time_training, training_seconds
from ethbrake_marl.studies.tuning.plan import TuningPlan

_TIMED_DRIVES = 50  # worlds that the timed policy drives


def seconds_per_trial(plan: TuningPlan) -> float:
    """Seconds of one core for a training with the recipe's own values, by a short one."""
    training = plan.training({})
    sample = training.scenario.sample(_TIMED_DRIVES, training.recipe.evaluation.seed)
    timed = time_training(training.recipe, training.scenario, sample)
    return training_seconds(training.recipe, training.scenario, timed, training.recipe.total_steps)
