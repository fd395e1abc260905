"""One of many trainings, for sweeps and studies: it is started, resumed, or read if it has finished."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from ethbrake_marl.episode.counts import BUILT_IN_COUNTS
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import check_folder, hold_lock, remove_unfinished
from ethbrake_marl.progress import OnProgress
from ethbrake_marl.training.fixed_list import deciding
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.train import resume, train
from ethbrake_marl.training.training import Training

MEASURED = (*(count.column for count in BUILT_IN_COUNTS), "collision_rate")


@contextmanager
def folder_of_many(folder: Path, *results: str) -> Iterator[None]:
    """Raises ``InvalidInput`` if another process uses the folder, or if it cannot be written to."""
    check_folder(folder, results, force=True)
    folder.mkdir(parents=True, exist_ok=True)
    with hold_lock(folder / ".lock", "another process works in this folder; wait until it ends, or end it"):
        remove_unfinished(folder)
        yield


class Job(NamedTuple):
    """It can be pickled."""

    training: Training
    folder: Path  # of the run; need not exist
    settings: tuple[str, ...] = ()  # ``KEY=VALUE``: changes of recipe and scenario files, for ``config.json``

    def finish(self, on_progress: OnProgress | None = None) -> bool:
        """False if Ctrl-C stopped it. Raises the errors of ``train``, and ``InvalidInput`` if the folder has another
        training.
        """
        recipe, scenario = self.training.recipe, self.training.scenario
        if not self.folder.exists():
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            ended = train(recipe, scenario, self.folder, settings=self.settings, on_progress=on_progress)
            return ended.status == "finished"
        run = RunFolder(self.folder)
        if run.training().identity != self.training.identity:
            raise InvalidInput(f"{self.folder}: has a training with other settings; delete it, or use another folder")
        if read_object(run.status)["status"] == "finished":
            return True
        return resume(self.folder, on_progress=on_progress).status == "finished"

    def attempt(self) -> str:
        """``finish``; the message of its error, empty if there is none. Ctrl-C raises ``KeyboardInterrupt``."""
        try:
            if not self.finish():
                raise KeyboardInterrupt
        except EthBrakeError as error:
            return str(error)
        return ""

    def result(self) -> dict[str, float]:
        """Best evaluation of a finished training, as a dictionary: ``steps``, ``harm`` (the minimised metric), and each
        metric named in ``MEASURED``.
        """
        count = self.training.recipe.reward.harm_count
        evaluations = read_object(RunFolder(self.folder).status)["evaluations"]
        best = min(evaluations, key=lambda evaluation: deciding(evaluation, count))
        return {"steps": best["steps"], "harm": deciding(best, count), **{name: best[name] for name in MEASURED}}
