"""One job of a sweep, wherever it runs: train to the end, then read what the run's folder says of it."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.durable import remove_folder
from ethbrake_marl.learning.loop import StopAt
from ethbrake_marl.learning.progress import OBJECTIVE, chosen_by
from ethbrake_marl.learning.run_folder import RunDirectory, is_finished, progress_rows, wait_for_others
from ethbrake_marl.learning.training import Training, check_same
from ethbrake_marl.policies.policy import Policy, has_bundle
from ethbrake_marl.policies.team import read_trained
from ethbrake_marl.studies.jobs.training import TrainingJob, finish_training

_MEASURED = ("first_impact_harm", "total_harm", "collision_rate")
RESULTS = (
    "steps",  # decisions of learners in whole updates
    "policy_steps",  # decisions after which the kept policy was taken: the best one on the recipe's list
    *_MEASURED,  # of the kept policy on that list
    OBJECTIVE,  # likewise, where a learner has another objective than total
    *(f"last_{name}" for name in _MEASURED),  # of the last one
    "policy_sha256",  # of the kept policy's manifest, of several vehicle_i=... each
)
_FREE_S = 60.0  # a worker that has lost its driver may hold the folder for a moment


def do_job(job: TrainingJob, log: Path, stop_at: StopAt | None = None) -> tuple[str, ...] | None:
    """The values of ``RESULTS``, as text; None where the training was stopped before its end, by ``stop_at`` too.

    What is printed goes to ``log``, which is deleted at a good end. Raises what a training raises, ``InvalidInput``
    where the sweep's folder cannot be seen or the run's folder holds another training, and ``BlockingIOError`` where
    another worker has just begun it.
    """
    if not log.parent.is_dir():
        raise InvalidInput(
            f"{log.parent}: is not there on {os.uname().nodename}; every computer of a cluster must see the sweep's"
            " folder"
        )
    with _printing_to(log):
        if RunDirectory(job.folder).status.is_file():
            wait_for_others(job.folder, _FREE_S)
            check_same(job.folder, job.training)
            if is_finished(job.folder) and not _keeps_policies(job):
                remove_folder(job.folder)  # a finished run has no checkpoint: it is trained anew
        try:
            finished = finish_training(job, stop_at=stop_at)
        except AlreadyExists as error:  # begun in this moment by a worker that has lost its driver
            raise BlockingIOError(str(error)) from None
        found = read_results(job.training, job.folder) if finished else None
    if found is not None:
        log.unlink(missing_ok=True)
    return found


def _keeps_policies(job: TrainingJob) -> bool:
    return all(has_bundle(job.folder / place) for place in job.training.drivers.values())


def read_results(training: Training, folder: Path) -> tuple[str, ...]:
    """The values of ``RESULTS`` of a finished training, in the text that its table has."""
    table = [row for row in progress_rows(folder) if row.get(f"eval/{_MEASURED[0]}")]
    if not table:
        raise InvalidInput(f"{RunDirectory(folder).progress}: holds no evaluation; delete its folder to train anew")
    harm = chosen_by(table, training.recipe.reward.harm_count, "eval/")
    kept, last = min(table, key=lambda row: float(row[harm])), table[-1]
    trained = read_trained(RunDirectory(folder).policy)
    if isinstance(trained, Policy):
        sha256 = trained.manifest.manifest_sha256
    else:
        sha256 = " ".join(f"{name}={policy.manifest.manifest_sha256}" for name, policy in trained.members.items())
    measured, later = ([row[f"eval/{name}"] for name in _MEASURED] for row in (kept, last))
    return (last["steps"], kept["steps"], *measured, kept.get(f"eval/{OBJECTIVE}", ""), *later, sha256)


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """What this process prints inside goes to a file, from every library, and the end of an error with it."""
    sys.stdout.flush()
    sys.stderr.flush()
    before = os.dup(1), os.dup(2)
    with log.open("ab", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield
        except BaseException:
            traceback.print_exc(file=os.fdopen(os.dup(file.fileno()), "w"))
            raise
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for descriptor, kept in enumerate(before, 1):
                os.dup2(kept, descriptor)
                os.close(kept)
