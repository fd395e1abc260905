"""Train, or resume a training: build the model, learn, evaluate, save."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import hold_lock, remove_folder, remove_unfinished
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.progress import Progress, Told
from ethbrake_marl.registry import versions_used
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.stopping import stop_on_signal
from ethbrake_marl.training.callback import RunCallback, StopAt, StopRequested, Watchers
from ethbrake_marl.training.checkpoint import TrainingState, newest_usable
from ethbrake_marl.training.finite import FiniteNumbers, TrainingDiverged, weights_are_finite
from ethbrake_marl.training.fixed_list import Measure, measure_on_list
from ethbrake_marl.training.logs import open_logs
from ethbrake_marl.training.models import Learner, make_environment, make_model
from ethbrake_marl.training.random_state import own_random_state
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe
from ethbrake_marl.training.run_folder import RunDirectory, RunStatus
from ethbrake_marl.training.training import Training, recorded_training

Ended = Literal["finished", "interrupted"]

_BUSY = "another process is training here"


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Result of ``train`` or ``resume``: the policies, and how the training went.

    ``trained`` is the policy with the least harm on the fixed list, or the last policy if nothing was measured.

    >>> import ethbrake_marl as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')

    """

    directory: Path  # the run's folder
    training: Training  # recipe and scenario
    trained: Trained  # one policy for all learners, or one for each; also saved as directory/policy
    last: Trained  # policy or policies at the end; also saved as directory/policy-last
    status: Ended  # finished or interrupted
    steps: int  # decisions of all learners together, whole updates
    updates: int  # rounds of collecting and learning
    wall_s: float  # time that all processes spent on this training (s)
    evaluations: tuple[Mapping[str, float], ...]  # steps, updates and metrics of each evaluation, in order

    @property
    def agent(self) -> str:
        """Name of what was trained as an agent, for ``make_agent`` and ``--agents``: ``ppo@runs/mine``."""
        return self.training.agent_in(self.directory)

    @property
    def metrics(self) -> Mapping[str, float] | None:
        """Results of ``trained`` on the fixed list (an entry of ``evaluations``); None if nothing was measured."""
        return next((each for each in self.evaluations if each["steps"] == self.trained.steps), None)

    @property
    def policies(self) -> dict[str, Policy]:
        """The policy of each learner, by the vehicle's name."""
        return dict(self.trained.drivers)

    @property
    def policy(self) -> Policy:
        """The policy that drives all learners; raises ``InvalidInput`` if each learner has its own."""
        return _only(self.trained)

    @property
    def last_policy(self) -> Policy:
        """The policy at the end of the training; raises ``InvalidInput`` if each learner has its own."""
        return _only(self.last)


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(f"training: {', '.join(trained.drivers)} have a policy each; take one of policies")


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
    """Train the learners of ``scenario`` and write the run's folder: build, learn, evaluate, save.

    Ctrl-C stops after the current update (status ``interrupted``); a second Ctrl-C raises ``KeyboardInterrupt``. Unless
    the process is killed, ``policy/`` then holds the best policy so far and ``policy-last/`` the last good one.
    ``resume`` continues the training. The same recipe, scenario, seed and machine give the same policy, bit for bit.
    The global random generators are not changed.

    Args:
        recipe: a recipe, its name, or the path of its file.
        scenario: a scenario, its name, or the path of its file. Its roles determine the learners.
        directory: the new folder of the run.
        scheme: overrides the recipe's scheme. By default one learner is ``single``, several are ``shared``.
        turns: overrides the recipe's turns of independent learners (docs/train.md).
        seed: overrides the recipe's seed.
        steps: overrides the recipe's number of decisions. The last update may exceed it.
        force: replace an earlier run.
        settings: how recipe and scenario differ from their files, ``KEY=VALUE`` each; recorded in ``config.json``.
        measure: called with the training; returns the function that measures its policies before the first update,
            every few updates (a key of the recipe), and at the end. By default the recipe's fixed list. None: no
            measurements.
        stop_at: called with every evaluation (an entry of ``TrainResult.evaluations``); returns a reason to stop there
            with status ``interrupted``, or None.
        on_progress: called with the progress. By default it is shown on stderr; None: silent.

    Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` if recipe and scenario do not
    fit each other, ``TrainingDiverged`` for numbers that are not finite.

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
    """Continue a training that was stopped or killed. Its policies are the same, bit for bit, as without the stop.

    Training continues from the newest undamaged checkpoint, or from the beginning if there is none. Rows and events
    after that checkpoint are dropped. Results and reports that ``ethbrake run`` wrote about the policy so far are
    deleted.

    Args:
        directory: the run's folder.
        measure: the argument that ``train`` was called with.
        stop_at: the argument that ``train`` was called with. It is called with new evaluations only.
        on_progress: called with the progress. By default it is shown on stderr; None: silent.
        other_versions: accept a checkpoint that other versions wrote, although the numbers may differ.

    Raises ``InvalidInput`` for a folder without a training, with a finished training, with one that another process is
    running, with a ``config.json`` edited since the checkpoint, and with a checkpoint of other versions.

    """
    run = RunDirectory(Path(directory))
    training = recorded_training(run, run.read_config())
    _check_unfinished(run, training)
    with build(training, run, measure, stop_at, on_progress) as callback:
        run.write_json(run.team, training.team())  # the one that is there may be damaged
        with hold_lock(run.lock, _BUSY):
            state, damaged = _newest_checkpoint(run, training, other_versions)
            run.remove_results()
            return learn(callback, state, [f"a damaged checkpoint was left aside: {reason}" for reason in damaged])


@contextmanager
def build(
    training: Training, run: RunDirectory, measure: Measure | None, stop_at: StopAt | None, on_progress: Told
) -> Iterator[RunCallback]:
    """Context manager: build environment and model of a training, and yield the callback to pass to ``learn``.

    Inside, Ctrl-C stops the training after the current update. At the end, also after an error, the environment is
    closed and the global random generators are restored.

    Args:
        training: recipe and scenario.
        run: folder of the run; nothing is written yet.
        measure: as in ``train``.
        stop_at: as in ``train``.
        on_progress: as in ``train``.

    """
    evaluate = None if measure is None else measure(training)
    algorithm = training.recipe.make_algorithm()
    with own_random_state(), stop_on_signal() as stop, closing(make_environment(training)) as environment:
        learner = Learner(training, algorithm, make_model(algorithm, training, environment))
        yield RunCallback(run, learner, Watchers(evaluate, stop_at, Progress.listener(on_progress), stop))


def learn(callback: RunCallback, state: TrainingState | None, notes: Sequence[str] = ()) -> TrainResult:
    """Run the training of a callback to its end or the next stop; then save, and return the result.

    However the training ends, its folder is complete.

    Args:
        callback: the callback from ``build``, which holds the model and measures it during the training.
        state: checkpoint to continue from; None: begin from scratch.
        notes: messages for the user, passed to ``on_progress`` when the training begins.

    """
    run, (training, algorithm, model), course = callback.run, callback.learner, callback.course
    if state is not None:
        callback.restore(state)
    elif training.begins is not None:
        callback.notes.append(f"begins with {training.begins}")
    callback.notes += notes
    run.write_status("running", start=training.begins)
    model.logger.output_formats = open_logs(run, state)
    status: Ended = "finished"
    reason: str | None = None
    try:
        model.learn(
            training.recipe.total_steps - model.num_timesteps,
            callback=[FiniteNumbers(), callback],
            log_interval=None,  # type: ignore[arg-type]  # the callback writes the rows
            reset_num_timesteps=state is None,
        )
    except StopRequested as stop:
        status, reason = "interrupted", stop.args[0]
    except BaseException as error:
        cause = error  # torch's message about a NaN in a distribution would not help the user
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
    """Save the best and the last good policy, and record in ``run.json`` how the run ended.

    The checkpoints of a finished run are deleted.

    Args:
        callback: the callback of the training, with its policies so far.
        status: how the run ended.
        reason: why it was interrupted or failed; None: no reason.

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
    """Raise ``InvalidInput`` if the training has finished, even if its evaluation by ``ethbrake run`` has not."""
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    if status["status"] == "finished" or (status.get("stage") is not None and not resumable):
        raise InvalidInput(
            f"{run.path}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {training.scenario.name} --agents full_brake,{training.agent_in(run.path)}"
        )


def _newest_checkpoint(
    run: RunDirectory, training: Training, other_versions: bool
) -> tuple[TrainingState | None, list[str]]:
    """Return the newest undamaged checkpoint (None if there is none), and what is wrong with newer ones.

    Raises ``InvalidInput`` if it belongs to another training, or, unless ``other_versions``, if other versions of the
    packages wrote it.
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
            f"{run.config}: was changed after the checkpoint {name} of this training; restore it, or"
            " train again in another folder"
        )
    now, then = installed_versions(), state.numbers["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # this process may have loaded more parts
    other = sorted(name for name in asked if now.get(name) != then.get(name))
    if other and not other_versions:
        name = other[0]
        raise InvalidInput(
            f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
            " differ; install that version, or continue anyway with --other-versions"
        )
    return state, damaged
