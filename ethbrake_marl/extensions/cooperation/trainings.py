"""Do the trainings of an ablation, several at once, and go on with those that were interrupted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cooperation.levels import Plan
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.parallel import run_each
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.train import resume, train
from ethbrake_marl.training.training import Training


def train_all(plan: Plan, jobs: int, tell: OnProgress) -> bool:
    """Start or continue every training until it ends; return False if Ctrl-C stopped one.

    The policies depend neither on ``jobs``, the number of trainings at the same time, nor on interruptions. Raises the
    errors of ``is_finished`` before any training begins.
    """
    left = [
        (training, folder, plan.settings_of(level))
        for level, _, _, training, folder in plan.trainings()
        if not is_finished(training, folder)
    ]
    if jobs == 1:
        return all(finish(*each, tell) for each in left)
    for done, finished in enumerate(run_each(((finish, *each) for each in left), jobs), 1):
        if not finished:
            return False
        tell(Progress("trainings", done, len(left)))
    return True


def is_finished(training: Training, folder: Path) -> bool:
    """Return whether the folder has the finished training.

    Raises ``InvalidInput`` for a folder with something else, or with a training of other settings.
    """
    run = RunFolder(folder)
    if not folder.exists():
        return False
    if run.training().identity != training.identity:
        raise InvalidInput(f"{folder}: has a training of other settings; move it, or give another --output")
    return bool(read_object(run.status)["status"] == "finished")


def finish(training: Training, folder: Path, settings: tuple[str, ...], tell: OnProgress | None = None) -> bool:
    """Start or continue a training until it ends; return False if Ctrl-C stopped it."""

    def say(progress: Progress) -> None:
        if tell is not None:
            tell(replace(progress, name=folder.name))

    if folder.exists():
        result = resume(folder, on_progress=say)
    else:
        folder.parent.mkdir(parents=True, exist_ok=True)
        result = train(training.recipe, training.scenario, folder, settings=settings, on_progress=say)
    return result.status == "finished"
