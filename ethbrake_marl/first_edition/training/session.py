"""Train policies, or resume a training run: build the model, let it learn, measure its policies, save them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import hold_lock, remove_folder, remove_unfinished
from ethbrake_marl.first_edition.policies.manifest import installed_versions
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.teams import Trained
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.callback import RunCallback, StopAt, StopRequested, Watchers
from ethbrake_marl.first_edition.training.checkpoint import TrainingState, newest_usable
from ethbrake_marl.first_edition.training.finite import FiniteNumbers, TrainingDiverged, weights_are_finite
from ethbrake_marl.first_edition.training.fixed_list import Measure, measure_on_list
from ethbrake_marl.first_edition.training.logs import open_logs
from ethbrake_marl.first_edition.training.models import Learner, make_environment, make_model
from ethbrake_marl.first_edition.training.random_state import own_random_state
from ethbrake_marl.first_edition.training.recipe import Scheme, TrainingRecipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory, RunStatus
from ethbrake_marl.first_edition.training.training import Training, recorded_training
from ethbrake_marl.progress import Progress, Told
from ethbrake_marl.registry import versions_used
from ethbrake_marl.stopping import stop_on_signal

Ended = Literal["finished", "interrupted"]

_BUSY = "another process is training in this folder"


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Result of ``train`` or ``resume``: the policies, and the evaluations during the training.

    ``trained`` is the best policy: the policy with the least harm on the fixed list of worlds (or the smallest mean of
    the learners' objectives, if they differ from the harm of the line), or the last policy if nothing was measured.

    >>> import ethbrake_marl.first_edition as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')
    """

    directory: Path  # the run's folder
    training: Training  # recipe and scenario
    trained: Trained  # best policy, or one best policy for each learner; also saved as directory/policy
    last: Trained  # policy or policies at the end of the training; also saved as directory/policy-last
    status: Ended  # whether the training finished or was interrupted
    steps: int  # number of decisions of all learners together
    updates: int  # number of updates (rounds of collecting and learning)
    wall_s: float  # wall time that all processes spent on this training (s)
    evaluations: tuple[Mapping[str, float], ...]  # steps, updates and metrics of each evaluation, in order of time

    @property
    def agent(self) -> str:
        """Text that names the trained agent for ``make_agent`` and ``--agents``, such as ``ppo@runs/mine``."""
        return self.training.agent_in(self.directory)

    @property
    def metrics(self) -> Mapping[str, float] | None:
        """Metrics of the policy ``trained`` on the fixed list of worlds; None if the policies were not measured."""
        return next((each for each in self.evaluations if each["steps"] == self.trained.steps), None)

    @property
    def policies(self) -> dict[str, Policy]:
        """Policy of each learner, by the vehicle's name."""
        return dict(self.trained.drivers)

    @property
    def policy(self) -> Policy:
        """Policy that drives all learners; raises ``InvalidInput`` if each learner has its own policy."""
        return _only(self.trained)

    @property
    def last_policy(self) -> Policy:
        """Policy at the end of the training; raises ``InvalidInput`` if each learner has its own policy."""
        return _only(self.last)


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(
        f"training: {', '.join(trained.drivers)} have different policies; use the attribute policies, for instance"
        f" policies[{next(iter(trained.drivers))!r}]"
    )


def train(
    recipe: TrainingRecipe | str | Path,
    scenario: Scenario | str | Path,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    turns: int | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    settings: Sequence[str] = (),
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
) -> TrainResult:
    """Train the learners of a scenario, and write the folder of the run.

    Ctrl-C stops the training after the current update (status ``interrupted``); a second Ctrl-C raises
    ``KeyboardInterrupt``. After Ctrl-C or an error, ``policy/`` contains the best policy so far, and ``policy-last/``
    the latest policy whose weights are finite. ``resume`` continues a stopped training run. The same recipe, scenario
    and seed give exactly the same policy on the same machine.

    Args:
        recipe: a recipe, its name, or the path of its file.
        scenario: a scenario, its name, or the path of its file. Its roles say which vehicles learn.
        directory: the new folder of the run.
        scheme: how several learners train together; None: the recipe's scheme.
        turns: number of turns of each independent learner (docs/train.md); None: the recipe's number.
        seed: seed of the training run; None: the recipe's seed.
        steps: number of decisions of all learners together; None: the recipe's number. The training ends with a whole
            update, so the learners may make a few more decisions.
        force: whether to replace an earlier run in ``directory``.
        settings: settings ``KEY=VALUE`` by which recipe and scenario differ from their files; ``config.json`` records
            them.
        measure: function that takes a ``Training`` and returns a function that measures policies; None: no
            measurements. By default, policies are measured on the fixed list of worlds that the recipe defines: before
            the first update, every few updates (a key of the recipe), and at the end.
        stop_at: function that takes an evaluation (an entry of ``TrainResult.evaluations``), and returns a reason to
            stop the training with status ``interrupted``, or None to continue.
        on_progress: function that is called with each ``Progress``; ``"show"``: print the progress on stderr; None: no
            reports.

    Raises ``AlreadyExists`` for an existing directory if ``force`` is false, ``InvalidInput`` if recipe and scenario do
    not fit each other, ``TrainingDiverged`` if a number is not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{name: value for name, value in changes.items() if value is not None})
    run = RunDirectory(Path(directory))
    with build(training, run, measure, stop_at, on_progress) as callback:  # may raise before the folder is created
        run.create(training.config(settings), team=training.team(), force=force)
        with hold_lock(run.lock, _BUSY):
            return learn(callback, None)


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Continue a training run that was stopped or killed. The policies are exactly the same as without the
    interruption.

    The training run continues from the newest undamaged checkpoint, or from the beginning if there is none. Log rows
    that were written after this checkpoint are dropped. Earlier results and reports of ``ethbrake run`` are deleted.

    Args:
        directory: the folder of the run.
        measure: as in ``train``.
        stop_at: as in ``train``. Evaluations that were made before the stop are not passed to ``stop_at`` again.
        on_progress: as in ``train``.
        other_versions: whether to accept a checkpoint that other versions of packages wrote. The resulting policies may
            then differ from the policies of an uninterrupted training run.

    Raises ``InvalidInput`` if the folder contains no training run or a finished one, if another process is training in
    the folder, if ``config.json`` was edited after the checkpoint was written, or if other versions of packages wrote
    the checkpoint.

    """
    run = RunDirectory(Path(directory))
    training = recorded_training(run, run.read_config())
    _check_unfinished(run, training)
    with build(training, run, measure, stop_at, on_progress) as callback:
        run.write_json(run.team, training.team())  # the existing file may be damaged
        with hold_lock(run.lock, _BUSY):
            state, damaged = _newest_checkpoint(run, training, other_versions)
            run.remove_results()
            return learn(callback, state, [f"deleted a damaged checkpoint: {reason}" for reason in damaged])


@contextmanager
def build(
    training: Training, run: RunDirectory, measure: Measure | None, stop_at: StopAt | None, on_progress: Told
) -> Iterator[RunCallback]:
    """Context manager: build environment and model of a training run, and yield the callback for ``learn``.

    Inside the ``with`` block, Ctrl-C stops the training after the current update. At the end of the ``with`` block, the
    environment is closed, and the global random generators are restored. The function does not write into the folder of
    the run yet. For ``measure``, ``stop_at`` and ``on_progress``, see ``train``.
    """
    evaluate = None if measure is None else measure(training)
    algorithm = training.recipe.make_algorithm()
    with own_random_state(), stop_on_signal() as stop, closing(make_environment(training)) as environment:
        learner = Learner(training, algorithm, make_model(algorithm, training, environment))
        yield RunCallback(run, learner, Watchers(evaluate, stop_at, Progress.listener(on_progress), stop))


def learn(callback: RunCallback, state: TrainingState | None, notes: Sequence[str] = ()) -> TrainResult:
    """Train until the training ends or is stopped, save the policies, and return the result.

    The policies are also saved if the training ends with an error. ``callback`` comes from ``build``. ``state`` is the
    checkpoint from which the training run continues; None: a new training run begins. ``notes`` are messages for the
    user, passed to ``on_progress`` when the training begins.
    """
    run, (training, algorithm, model), course = callback.run, callback.learner, callback.course
    if state is not None:
        callback.restore(state)
    elif training.begins is not None:
        callback.notes.append(f"initial weights: {training.begins}")
    callback.notes += notes
    run.write_status("running", start=training.begins)
    model.logger.output_formats = open_logs(run, state)
    status: Ended = "finished"
    reason: str | None = None
    try:
        model.learn(
            training.recipe.total_steps - model.num_timesteps,
            callback=[FiniteNumbers(), callback],
            log_interval=None,  # type: ignore[arg-type]  # the callback writes the logs
            reset_num_timesteps=state is None,
        )
    except StopRequested as stop:
        status, reason = "interrupted", stop.args[0]
    except BaseException as error:
        cause = error  # replaced below if torch reports a NaN in a distribution, which would not help the user
        if isinstance(error, ValueError) and not weights_are_finite(model, algorithm):
            cause = TrainingDiverged(
                f"training: a weight or the exploration noise is not finite at step {model.num_timesteps};"
                " try a smaller learning_rate"
            )
        ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        save(callback, ended, f"{type(cause).__name__}: {cause}")
        if cause is error:
            raise
        raise cause from error
    finally:
        model.logger.close()
    save(callback, status, reason)
    assert course.policy is not None and course.chosen is not None  # set before the first rollout
    return TrainResult(
        run.path, training, course.chosen, course.policy, status, course.steps, course.updates, course.wall_s,
        tuple(course.evaluations),
    )  # fmt: skip


def save(callback: RunCallback, status: RunStatus, reason: str | None) -> None:
    """Save the best policy and the last policy whose weights are finite; record in ``run.json`` how the run ended.

    The checkpoints of a finished run are deleted. ``reason`` says why the run was interrupted or failed; None: there is
    no reason to record.
    """
    run, training, course = callback.run, callback.learner.training, callback.course
    for policy, folder in ((course.chosen, run.policy), (course.policy, run.last_policy)):
        if policy is not None:
            policy.save(folder, replace=True)
    left_over = () if status == "finished" else run.checkpoints.glob("step_*")
    ending = {
        "start": training.begins,
        "reason": reason,
        "wall_s": round(course.wall_s, 3),
        "cpu_s": {str(steps): round(spent, 3) for steps, spent in course.cpu_s.items()},
        "steps": course.steps,
        "updates": course.updates,
        "policy_steps": None if course.chosen is None else course.chosen.steps,
        "policy": run.policy.name if run.policy.is_dir() else None,
        "checkpoints": sorted(path.name for path in left_over),
    }
    run.write_status(status, **ending)
    if status == "finished" and run.checkpoints.is_dir():
        remove_folder(run.checkpoints)


def _check_unfinished(run: RunDirectory, training: Training) -> None:
    """Raise ``InvalidInput`` if the training run has finished, even if ``ethbrake run`` has not evaluated it yet."""
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    if status["status"] == "finished" or (status.get("stage") is not None and not resumable):
        raise InvalidInput(
            f"{run.path}: this training run has finished and cannot be resumed; evaluate its policy with: ethbrake"
            f" evaluate --scenario {training.scenario.name} --agents full_brake,{training.agent_in(run.path)}"
        )


def _newest_checkpoint(
    run: RunDirectory, training: Training, other_versions: bool
) -> tuple[TrainingState | None, list[str]]:
    """Return the newest undamaged checkpoint (or None), and error messages about damaged newer checkpoints.

    Raises ``InvalidInput`` if the checkpoint belongs to another training run, or if other versions of packages wrote it
    (unless ``other_versions`` is true).
    """
    remove_unfinished(run.path)
    if run.checkpoints.is_dir():
        remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is None:
        return None, damaged
    if state.numbers.get("training") != training.identity:
        name = run.checkpoint(state.steps).name
        raise InvalidInput(
            f"{run.config}: this file was changed after the checkpoint {name} was written; restore the old content,"
            " or train again in another folder"
        )
    now, then = installed_versions(), state.numbers["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # this process may have loaded more parts
    other = sorted(name for name in asked if now.get(name) != then.get(name))
    if other and not other_versions:
        name = other[0]
        raise InvalidInput(
            f"{run.path}: this training run began with {name} {then.get(name)}, but {name} {now.get(name)} is installed"
            " and may compute other numbers; install the old version, or continue anyway (--other-versions)"
        )
    return state, damaged
