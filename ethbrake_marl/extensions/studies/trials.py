"""Run many trials on Ray Tune, each on one core. A trial whose process ends unexpectedly is started again.

Ray stores its own state as pickles in a temporary folder, which is removed at the end of the command. Ray's
``Tuner.restore`` is not used, because it loads pickles, which may be unsafe. Instead, an interrupted trial continues
from the files in its own folder.
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
    callback: TrialCallback,
) -> list[dict[str, Any]]:
    """Run trials on Ray Tune. Return the last report of each trial that began, in the order in which the trials began.

    A report is the dictionary that ``work`` passes to ``tune.report``, with further entries of Ray. If the trial
    failed, the entry ``reason`` says why. The entry ``done`` is True if the trial has ended. Ctrl-C stops all trials.
    The caller must connect to Ray first (see ``cluster.connected``).

    Args:
        work: function that runs a trial in a worker process, called as ``work(config, **given)``.
        given: further keyword arguments of ``work``, the same for all trials.
        folder: folder of all results; every computer of a cluster must see it.
        config: settings of Ray Tune: search algorithm, scheduler and number of trials.
        space: values that Ray Tune tries, by key; the ``config`` that ``work`` gets has one value of each key.
        jobs: number of trials that run at once; None: one for each core.
        retries: number of times that a trial is started again after its process ended unexpectedly, or after an
            exception that is not an ``EthBrakeError``.
        callback: callback that reports the trials that have ended.

    """
    config.max_concurrent_trials, config.reuse_actors = jobs, True
    with TemporaryDirectory(prefix="ethbrake-ray-") as notes, redirect_stdout(StringIO()):
        trainable = tune.with_parameters(_attempt, work=work, given=given, folder=folder.absolute())
        results = tune.Tuner(
            tune.with_resources(trainable, {"CPU": 1}),
            param_space=dict(space),
            tune_config=config,
            run_config=tune.RunConfig(
                storage_path=notes,
                failure_config=tune.FailureConfig(max_failures=retries),
                callbacks=[callback],
                verbose=0,
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
    """Run one attempt at a trial with the configuration ``config``; for the other arguments see ``run_trials``.

    An ``EthBrakeError`` is caught and reported as the result of the trial, because Ray would repeat the trial after an
    exception.
    """
    try:
        if not folder.is_dir():
            raise InvalidInput(
                f"{folder}: the computer {os.uname().nodename} does not have this folder; every computer of the cluster"
                " must see it under the same path"
            )
        work(config, **given)
    except EthBrakeError as error:
        tune.report({REASON: str(error), HARM: math.inf})


class TrialCallback(tune.Callback):  # type: ignore[misc]  # Ray ships no types
    """Callback of Ray Tune that reports the number of ended trials, and the reasons of failures.

    Args:
        name: name of the study, for the progress display.
        done: number of trials that ended in earlier runs of the command.
        total: number of all trials.
        tell: called with a ``Progress`` object at each report.

    """

    def __init__(self, name: str, done: int, total: int, tell: OnProgress | None) -> None:
        self._name, self._done, self._total, self._tell = name, done, total, tell or (lambda progress: None)

    def __getstate__(self) -> dict[str, Any]:
        """Return an empty state for Ray to store, because Ray never reads the state."""
        return {}

    def say(self, note: str = "") -> None:
        """Report how many trials have ended. ``note`` is an additional message to print."""
        self._tell(Progress(self._name, self._done, self._total, note=note))

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Count a trial that has ended, and report the reason if it failed."""
        self._done += 1
        self.say(str(trial.last_result.get(REASON, "")))

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Count a trial that has failed at its last attempt."""
        self._done += 1
        self.say("a trial failed after all attempts; the table contains the reason")

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Report that a trial starts again after its process has ended unexpectedly."""
        self.say("the process of a trial was lost or failed; the trial is tried again")
