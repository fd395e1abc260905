"""Run many trials on Ray Tune, each with one core and thread; a trial whose process was lost is tried again.

Ray stores its state as pickles in a temporary folder that ends with the command. ``Tuner.restore`` is not used, because
it would load pickles that a stranger may have written. Instead, a trial continues from its own folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ray import tune

from ethbrake_marl.errors import EthBrakeError, InvalidInput, describe_error
from ethbrake_marl.extensions.studies.figures import HARM, REASON
from ethbrake_marl.progress import OnProgress, Progress


def run_trials(
    work: Callable[..., None],
    given: Mapping[str, Any],
    folder: Path,
    config: tune.TuneConfig,
    space: Mapping[str, Any],
    *,
    jobs: int | None,
    retries: int,
    told: Told,
) -> list[dict[str, Any]]:
    """Run trials on Ray Tune, and return the last report of each trial that began, in order.

    A report is the dictionary that ``work`` passed to ``tune.report``, with Ray's own entries. Its entry ``reason``
    says why a trial failed; ``done`` is true if Ray has ended the trial. Ctrl-C ends all trials early. Ray must be
    connected (see ``cluster.connected``).

    Args:
        work: called as ``work(config, **given)`` in a worker process; reports with ``tune.report``.
        given: arguments that are the same for all trials.
        folder: folder of all results; every computer of a cluster must see it.
        config: Ray Tune's settings: search algorithm, scheduler and number of trials.
        space: Ray Tune's space of configurations: key -> values.
        jobs: trials at once; None: one for each core.
        retries: further attempts at a trial whose process was lost, or that failed with an error from outside this
            package.
        told: callback that reports ended trials.

    """
    config.max_concurrent_trials, config.reuse_actors = jobs, True
    with TemporaryDirectory(prefix="ethbrake-ray-") as notes, redirect_stdout(StringIO()):
        trainable = tune.with_parameters(_attempt, work=work, given=given, folder=folder.absolute())
        results = tune.Tuner(
            tune.with_resources(trainable, {"CPU": 1}),
            param_space=dict(space),
            tune_config=config,
            run_config=tune.RunConfig(
                storage_path=notes, failure_config=tune.FailureConfig(max_failures=retries), callbacks=[told], verbose=0
            ),
        ).fit()
    return [
        {
            **(each.metrics or {}),
            **(
                {REASON: describe_error(getattr(each.error, "cause", None) or each.error)}
                if each.error is not None
                else {}
            ),
        }
        for each in results
    ]


def _attempt(config: dict[str, Any], work: Callable[..., None], given: Mapping[str, Any], folder: Path) -> None:
    """Run one attempt at a trial with the configuration ``config``; arguments as in ``run_trials``.

    Errors of this package are reported, not raised, so that Ray does not try again.
    """
    try:
        if not folder.is_dir():
            raise InvalidInput(f"{folder}: is not there on {os.uname().nodename}; every computer must see this folder")
        work(config, **given)
    except EthBrakeError as error:
        tune.report({REASON: str(error), HARM: math.inf})


class Told(tune.Callback):  # type: ignore[misc]  # Ray ships no types
    """Callback of Ray Tune that reports how many trials have ended, and why some failed.

    Args:
        name: name of the study, for the progress.
        done: number of trials that had ended before.
        total: number of all trials.
        tell: called with a ``Progress``; None: silent.

    """

    def __init__(self, name: str, done: int, total: int, tell: OnProgress | None) -> None:
        self._name, self._done, self._total, self._tell = name, done, total, tell or (lambda progress: None)

    def __getstate__(self) -> dict[str, Any]:
        """Return an empty state for Ray to store, because it is never read."""
        return {}

    def say(self, note: str = "") -> None:
        """Report how many trials have ended, with ``note`` as a message to print once."""
        self._tell(Progress(self._name, self._done, self._total, note=note))

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Count a trial that ended, or that cannot succeed, and report why; Ray calls this method."""
        self._done += 1
        self.say(str(trial.last_result.get(REASON, "")))

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Count a trial that has failed after all its attempts; Ray calls this method."""
        self._done += 1
        self.say("a process was lost or failed, too often: the table says why")

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Report that a trial is tried again; Ray calls this method."""
        self.say("a process was lost or failed: tried again")
