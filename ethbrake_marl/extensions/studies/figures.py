"""Train one job of a sweep or tuning to its end in the job's folder, and return the values of its row in the table."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from typing import Any

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.teams import read_trained
from ethbrake_marl.training.callback import StopAt
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.training import check_same_training

_MEASURED = ("first_impact_harm", "total_harm", "collision_rate")

FIGURES = (
    "steps",  # decisions of learners in whole updates
    "policy_steps",  # decisions after which the saved policy (the best one on the recipe's list) was saved
    *_MEASURED,  # measures of the saved policy on the recipe's list
    RunDirectory.OBJECTIVE,  # objective of the saved policy, if a learner has another objective than total harm
    *(f"last_{name}" for name in _MEASURED),  # measures of the last policy
    "policy_sha256",  # hash of the saved policy's manifest; "vehicle_i=HASH ..." if there are several policies
)

HARM = "harm"  # additional key: the quantity by which the saved policy is the best

REASON = "reason"  # key that replaces FIGURES: why a training cannot succeed

Evaluation = Mapping[str, float]  # one evaluation during a training: number of steps and measures, by name


def is_done(job: TrainingJob) -> bool:
    """Return whether the folder of ``job`` contains the finished training run with its policies.

    Raises ``InvalidInput`` if the folder contains a training run with other settings.
    """
    run = RunDirectory(job.folder)
    if not run.is_finished:
        return False
    check_same_training(run, job.training)
    return all(Policy.stands_in(job.folder / place) for place in job.training.drivers.values())


def finish(job: TrainingJob, stop_at: StopAt | None = None) -> bool:
    """Start or continue the training run of ``job`` until it ends. Return False if ``stop_at`` stopped the run early.

    ``stop_at`` is called with each evaluation; it returns a reason to stop, or None to continue. Raises the exceptions
    of ``train`` and ``resume``, ``InvalidInput`` if the folder contains a training run with other settings, and
    ``BlockingIOError`` if another process has just begun the same training run.
    """
    run = RunDirectory(job.folder)
    if run.status.is_file():
        run.wait_for_others(60.0)  # a worker whose main process ended may still lock the folder
        check_same_training(run, job.training)
        if run.is_finished and not is_done(job):
            remove_folder(job.folder)  # the policies are missing, and a finished training has no checkpoint: train anew
    try:
        return bool(job.finish(stop_at=stop_at))
    except AlreadyExists as error:
        raise BlockingIOError(str(error)) from None


def evaluations_of(job: TrainingJob) -> list[dict[str, float]]:
    """Return the evaluations of ``job`` so far, each as a dictionary with ``steps`` and the measures.

    Raises ``InvalidInput`` if the file ``progress.csv`` is damaged.
    """
    run, names = RunDirectory(job.folder), (*_MEASURED, RunDirectory.OBJECTIVE)
    try:
        rows = [row for row in (run.rows() if run.progress.is_file() else []) if row.get(f"eval/{_MEASURED[0]}")]
        evaluations = [
            {"steps": int(row["steps"])} | {n: float(row[f"eval/{n}"]) for n in names if row.get(f"eval/{n}")}
            for row in rows
        ]
        if any(not {*_MEASURED} <= each.keys() or not all(map(math.isfinite, each.values())) for each in evaluations):
            raise ValueError("a value of an evaluation is missing or not finite")
    except (ValueError, LookupError, csv.Error) as error:
        raise InvalidInput(
            f"{run.progress}: the file is damaged ({error}); delete the run's folder to train again"
        ) from None
    return evaluations


def figures(job: TrainingJob, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """Return the values for the table's row of ``job``, by column, computed from the ``evaluations`` so far.

    The columns are ``harm`` (the least harm in any evaluation) and all ``FIGURES`` except ``policy_sha256``. Example:
    ``{"harm": 7.1, "steps": 400000, "total_harm": 9.8, ...}``.
    """
    harm = RunDirectory.chosen_by(evaluations, job.training.recipe.reward.harm_count)
    lowest, last = min(evaluations, key=lambda each: each[harm]), evaluations[-1]
    return {
        HARM: lowest[harm],
        "steps": last["steps"],
        "policy_steps": lowest["steps"],
        **{name: lowest[name] for name in (*_MEASURED, RunDirectory.OBJECTIVE) if name in lowest},
        **{f"last_{name}": last[name] for name in _MEASURED},
    }


def final_figures(job: TrainingJob) -> dict[str, Any]:
    """Return the values for the table's row of the finished ``job``, by column: ``harm`` and all ``FIGURES``.

    Raises ``InvalidInput`` if a file of the run is damaged.
    """
    run, evaluations = RunDirectory(job.folder), evaluations_of(job)
    if not evaluations:
        raise InvalidInput(f"{run.progress}: the file contains no evaluation; delete the run's folder to train again")
    trained = read_trained(run.policy)
    if isinstance(trained, Policy):
        sha256 = trained.manifest.manifest_sha256
    else:
        sha256 = " ".join(f"{name}={policy.manifest.manifest_sha256}" for name, policy in trained.drivers.items())
    return {**figures(job, evaluations), "policy_sha256": sha256}
