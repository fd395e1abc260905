"""Training everything that an ablation needs: finished trainings are kept, begun ones go on, several at once."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess

from ethbrake_marl.ablation.plan import Training
from ethbrake_marl.learning.callback import Progress
from ethbrake_marl.learning.run_directory import RunDirectory
from ethbrake_marl.learning.teams import load_team, resume_team, train_team

Tell = Callable[[str, int, int], None]  # what, how far, of how much


def train_all(trainings: Sequence[Training], jobs: int, tell: Tell | None = None) -> bool:
    """Bring every training to its end, ``jobs`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``jobs`` or on interruptions. Raises what ``Training.steps_left`` and ``train_team``
    raise.
    """
    left = [training for training in trainings if training.steps_left()]
    say = tell or (lambda name, done, total: None)
    if jobs == 1 or len(left) < 2:
        return all(_train(training, partial(_told, say, training.folder.name)) for training in left)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_begin_worker) as pool:
        futures = [pool.submit(_train, training) for training in left]
        say("trainings", 0, len(left))
        try:
            for done, future in enumerate(as_completed(futures)):
                if not future.result():
                    raise KeyboardInterrupt
                say("trainings", done + 1, len(left))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in active_children():
                worker.terminate()  # a training ends after its update, with a checkpoint
            return False
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return True


def check_finished(trainings: Iterable[Training]) -> None:
    """Raise what ``load_team`` raises for a finished training that cannot drive, before anything long is begun."""
    for training in trainings:
        if not training.steps_left():
            load_team(training.folder, training.level.scenario)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, which passes it on once, and end with the parent however that ends."""
    os.setpgrp()
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _train(training: Training, tell: Callable[[Progress], None] | None = None) -> bool:
    """Whether it is finished now."""
    if RunDirectory(training.folder).status.is_file():
        return resume_team(training.folder, on_progress=tell).status == "finished"
    training.folder.parent.mkdir(parents=True, exist_ok=True)
    result = train_team(training.recipe, training.level.scenario, training.folder, on_progress=tell)
    return result.status == "finished"


def _told(tell: Tell, name: str, progress: Progress) -> None:
    tell(name, progress.steps, progress.total_steps)
