"""Training runs of a study: do several at once, and continue them after an interruption."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ethbrake_marl.errors import EthBrakeError, InvalidInput, plain_text
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.parallel import run_each
from ethbrake_marl.progress import OnProgress, Progress

if TYPE_CHECKING:
    from ethbrake_marl.training.training import Training

MEASURES = ("first_impact_harm", "total_harm", "collision_rate")


class TrainingJob(NamedTuple):
    """A training run of a study, and its folder."""

    training: Training  # recipe and scenario
    folder: Path  # of the run; it need not exist yet
    noted: tuple[str, ...] = ()  # settings ``KEY=VALUE`` that changed scenario and recipe, for ``config.json``

    def steps_left(self) -> int:
        """Return the number of decisions until the end of the training run; 0 if the run has finished.

        Raises ``InvalidInput`` if the folder is no training run, or one with other settings.
        """
        from ethbrake_marl.training.run import RunFolder  # torch takes seconds to load

        run, total = RunFolder(self.folder), self.training.recipe.total_steps
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(
                    f"{self.folder}: the folder was not written by a training run; move it, or give another --output"
                )
            return total
        try:
            status, before = read_object(run.status), run.training()
        except InvalidInput as error:
            raise InvalidInput(f"{error}; delete the run's folder to train again") from None
        if before.identity != self.training.identity:
            raise InvalidInput(
                f"{self.folder}: this training run has another recipe or another scenario; move it, or give another"
                " --output"
            )
        done = status.get("steps", 0)
        return 0 if status.get("status") == "finished" else max(total - (done if isinstance(done, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None) -> bool:
        """Start or continue the training run until it ends. Return False if Ctrl-C stopped it.

        Raises the errors of ``train`` and ``resume``.
        """
        from ethbrake_marl.training.run import RunFolder
        from ethbrake_marl.training.train import resume, train

        def say(progress: Progress) -> None:
            if tell is not None:
                tell(replace(progress, name=self.folder.name))

        if not self.steps_left():
            return True
        if RunFolder(self.folder).status.is_file():
            return resume(self.folder, on_progress=say).status == "finished"
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        recipe, scenario, *_ = self.training
        return train(recipe, scenario, self.folder, settings=self.noted, on_progress=say).status == "finished"

    def attempt(self) -> str:
        """Start or continue the training run until it ends. Return "", or the reason if it fails or is damaged.

        Raises ``KeyboardInterrupt`` if Ctrl-C stopped it.
        """
        try:
            if not self.finish():
                raise KeyboardInterrupt
            self.result()
        except EthBrakeError as error:
            return str(error)
        return ""

    def result(self) -> dict[str, float]:
        """Return ``steps``, ``harm`` (what the saved policy has least) and measures of the finished run's policy.

        Raises ``InvalidInput`` if they cannot be read.
        """
        from ethbrake_marl.training.fixed_list import deciding
        from ethbrake_marl.training.run import RunFolder

        run, count = RunFolder(self.folder), self.training.recipe.reward.harm_count
        try:
            rows = [row for row in run.rows() if row.get("eval/total_harm")]
            each = [{name[5:]: float(cell) for name, cell in row.items() if name[:5] == "eval/"} for row in rows]
            best = min(range(len(rows)), key=lambda k: deciding(each[k], count))
            measures = {name: each[best][name] for name in MEASURES}
            return {"steps": int(rows[best]["steps"]), "harm": deciding(each[best], count), **measures}
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise InvalidInput(
                f"{run.progress}: is damaged ({plain_text(str(error))}); delete the run's folder to train again"
            ) from None


def train_all(trainings: Sequence[TrainingJob], jobs: int = 1, tell: OnProgress | None = None) -> bool:
    """Start or continue every training run until it ends. Return False if one was stopped before its end.

    ``jobs`` runs are trained at the same time, each in a process of its own; the policies do not depend on it. Before
    any run begins, raises the errors of ``steps_left``; later those of the first run that fails.
    """
    left = [training for training in trainings if training.steps_left()]
    if jobs == 1 or len(left) < 2:
        return all(training.finish(tell) for training in left)
    say = tell or (lambda progress: None)
    say(Progress("trainings", 0, len(left)))
    for done, finished in enumerate(run_each(((training.finish,) for training in left), jobs), 1):
        if not finished:
            return False
        say(Progress("trainings", done, len(left)))
    return True
