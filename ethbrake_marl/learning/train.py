"""Train: recipe and scenario in, a run's folder with the policies out; or go on with a training that stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput, OnProgress, Told, listener
from ethbrake_marl.files.store import remove_folder, remove_unfinished
from ethbrake_marl.learning.algorithms.networks import tensors_of
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.checkpoint import TrainingState, check_fits, newest_usable, prune, write_checkpoint
from ethbrake_marl.learning.loop import BetweenUpdates, Evaluate, StopAt, StopRequested, measure_on_list
from ethbrake_marl.learning.progress import (
    Course,
    EventFile,
    Model,
    ProgressTable,
    TrainingDiverged,
    capture_model,
    cut_back,
    event_sizes,
    own_random_state,
    replay_arrays,
    restore_log,
    restore_model,
    restore_replay,
    watch_gradients,
    weights_are_finite,
)
from ethbrake_marl.learning.recipe import Scheme, TrainingRecipe, algorithm_named
from ethbrake_marl.learning.team_file import team_content
from ethbrake_marl.learning.training import (
    RunDirectory,
    RunRecord,
    RunStatus,
    Training,
    check_run_plugins,
    create_run,
    has_finished,
    only_process,
    open_run,
    resolve,
    stop_on_signal,
    training_in,
)
from ethbrake_marl.observations import Appended
from ethbrake_marl.policies.actor import installed_versions, observation_schema
from ethbrake_marl.policies.bundle import Policy, PolicyTeam, Trained, drivers_of, make_policy, save_trained, steps_of
from ethbrake_marl.scenario import Scenario

# From a training to its model, and from a model's present weights to policies.


def make_model(algorithm: Algorithm, training: Training, environment: EthBrakeVecEnv) -> Model:
    """The model of a training, whose optimisers refuse gradients that are not finite."""
    model = algorithm.build(training, environment)
    if getattr(model, "get_vec_normalize_env", lambda: None)() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model is trained under VecNormalize, whose statistics are no"
            " part of a policy bundle; observations here are scaled already"
        )
    watch_gradients(model, algorithm)
    return model


def policy_maker(algorithm: Algorithm, training: Training) -> Callable[[Model], Trained]:
    """How to make policies of a model's present weights: one for all learners, or one for each."""
    recipe, scenario, observation = training.recipe, training.scenario, training.observation
    network = recipe.network_spec(observation.size)
    if training.scheme == "centralised":
        network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
    names = tuple(training.drivers)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(observation),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
        "versions": installed_versions(),
    }

    def make(actor: BasePolicy, learners: tuple[str, ...], steps: int) -> Policy:
        return make_policy(tensors_of(actor, network), learners=learners, steps=steps, **fixed)

    def policies(model: Model) -> Trained:
        actors = algorithm.actors(model)
        if training.scheme != "independent":
            (actor,) = actors
            return make(actor, names, model.num_timesteps)
        members = zip(names, actors, strict=True)
        return PolicyTeam({name: make(actor, (name,), model.num_timesteps) for name, actor in members})

    return policies


# One stretch of a training in one process: from a fresh model or a checkpoint, to the end or the next stop.

Ended = Literal["finished", "interrupted"]


class Session:
    """Keeps the run's folder complete while a model learns in it."""

    def __init__(self, run: RunDirectory, model: Model, algorithm: Algorithm, training: Training) -> None:
        self._run, self._model, self._algorithm, self._training = run, model, algorithm, training
        self._record = RunRecord(run)
        self._table = ProgressTable(run.progress)
        self._restored: TrainingState | None = None

    def save(self, between: BetweenUpdates) -> None:
        """Write a checkpoint of this moment, unless there is one, and delete those that are old."""
        course, folder = between.course, self._run.checkpoint(between.course.steps)
        if folder.exists():
            return
        assert course.policy is not None
        arrays, numbers = capture_model(self._model, self._algorithm)
        replay, replay_numbers = replay_arrays(self._model)
        numbers |= {
            "training": self._training.identity,
            "between": between.state(),
            "replay": replay_numbers,
            "events": event_sizes(self._run.tensorboard),
        }
        state = TrainingState(
            course.steps,
            course.updates,
            numbers,
            arrays,
            replay,
            course.policy,
            course.best,
            self._table.content(),
            installed_versions(),
        )
        write_checkpoint(folder, state)
        prune(self._run.checkpoints)

    def restore(self, between: BetweenUpdates, state: TrainingState | None) -> None:
        """Bring model, callback, table and events back to ``state``; None: to the beginning."""
        if state is None:
            self._run.progress.unlink(missing_ok=True)
            cut_back(self._run.tensorboard, {})
            return
        restore_model(self._model, self._algorithm, state.arrays, state.numbers)
        restore_replay(self._model, state.replay, state.numbers["replay"])
        between.restore(state.numbers["between"], state.steps, state.policy, state.best)
        self._table.restore(state.table)
        cut_back(self._run.tensorboard, state.numbers["events"])
        self._restored = state

    def learn(self, between: BetweenUpdates) -> Ended:
        """Train to the end, and leave the folder complete whatever that end is."""
        model, state = self._model, self._restored
        logger = Logger(str(self._run.path), [self._table, EventFile(self._run.tensorboard)])
        model.set_logger(logger)
        if state is not None:
            restore_log(model, state.numbers)
        status: Ended = "finished"
        reason: str | None = None
        try:
            steps = self._training.recipe.total_steps - model.num_timesteps
            model.learn(steps, callback=between, log_interval=None, reset_num_timesteps=state is None)  # type: ignore[arg-type]
        except StopRequested as stop:
            status, reason = "interrupted", stop.reason
        except BaseException as error:
            cause = self._explain(error)
            ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._close(between, ended, f"{type(cause).__name__}: {cause}")
            if cause is error:
                raise
            raise cause from error
        finally:
            logger.close()
        self._close(between, status, reason)
        return status

    def _close(self, between: BetweenUpdates, status: RunStatus, reason: str | None) -> None:
        """Save the best and the last good policy, say how the run ended; a finished one needs no checkpoint."""
        course = between.course
        self._save_policy(course.kept, "policy")
        self._save_policy(course.policy, "policy-last")
        left: dict[str, Any] = {
            "wall_s": round(course.wall_s, 3),
            "steps": course.steps,
            "updates": course.updates,
            "policy_steps": None if course.kept is None else steps_of(course.kept),
            "alarms": course.alarms,
        }
        self._record.end(status, reason, left)
        if status == "finished" and self._run.checkpoints.is_dir():
            remove_folder(self._run.checkpoints)

    def _save_policy(self, policy: Trained | None, name: str) -> None:
        if policy is not None:
            save_trained(policy, self._run.path / name, replace=True)

    def _explain(self, error: BaseException) -> BaseException:
        """The error to report: torch's own when a distribution gets a NaN says little about a training."""
        if isinstance(error, ValueError) and not weights_are_finite(self._model, self._algorithm):
            return TrainingDiverged(
                f"training: a weight or the exploration noise is not finite at step {self._model.num_timesteps};"
                " try a smaller learning_rate"
            )
        return error


_APPENDED: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}

Measure = Callable[[Training], Evaluate]


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind.

    ``trained`` is of the moment of least harm on the fixed list, or of the end where nothing was measured.

    >>> import ethbrake_marl as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')

    """

    directory: Path  # the run's folder
    training: Training  # recipe, scenario and what they come to
    trained: Trained  # one policy for all learners, or one for each; also saved as directory/policy
    last: Trained  # of the end; also saved as directory/policy-last
    status: Ended  # finished or interrupted
    steps: int  # decisions of all learners, a multiple of rows x rounds
    updates: int  # rounds of collecting and learning
    wall_s: float  # s, of all stretches together
    evaluations: tuple[Mapping[str, float], ...]  # what was measured on the way, in order
    alarms: tuple[str, ...]  # training lost, or harm up with the return

    @property
    def policies(self) -> dict[str, Policy]:
        """Vehicle -> the policy that drives it."""
        return drivers_of(self.trained, tuple(self.training.drivers))

    @property
    def policy(self) -> Policy:
        """The policy that drives all learners; raises ``InvalidInput`` where each has its own."""
        return _only(self.trained)

    @property
    def last_policy(self) -> Policy:
        """The same of the training's end."""
        return _only(self.last)


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
    stop_when_lost: bool = False,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
) -> TrainResult:
    """Train the learners of ``scenario`` into the new ``directory``.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it but a kill, ``policy/`` holds the best policy so far and ``policy-last/`` the last good one;
    ``resume`` goes on. The same recipe, scenario, seed and machine give the same policy, bit for bit; global random
    states are left as they were.

    Args:
        recipe: a recipe, its name, or the path of its file.
        scenario: a scenario, its name, or the path of its file; its roles say who learns.
        directory: the run's folder.
        scheme: overrides the recipe's; without any, one learner is ``single`` and several are ``shared``.
        turns: overrides the recipe's, of independent learners (docs/cooperation.md).
        seed: overrides the recipe's.
        steps: overrides the recipe's decisions of learners; training ends after the first update at or beyond them.
        force: replace an earlier run.
        settings: by which recipe and scenario differ from their files, ``KEY=VALUE`` each: noted in ``config.json``.
        measure: makes of the training what measures its policies before the first update, then as the recipe says, and
            at the end: by default on the recipe's fixed list. None: nothing is measured.
        stop_when_lost: stop, ``interrupted``, at an evaluation that finds the training lost (docs/learning.md).
        stop_at: is given every evaluation, as it stands in ``TrainResult.evaluations``, and gives a reason to stop
            there, ``interrupted``, or None.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.

    Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` where recipe and scenario do
    not fit each other, ``TrainingDiverged`` for numbers that are not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = resolve(recipe, scenario, **{name: value for name, value in changes.items() if value is not None})

    def begin() -> tuple[RunDirectory, None]:
        team = team_content(training.scheme, training.scenario)
        config = {**training.config(), **({"settings": list(settings)} if settings else {})}
        return create_run(Path(directory), config, team=team, force=force), None

    return _run(begin, training, measure, listener(on_progress), stop_when_lost, stop_at)


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
    stop_when_lost: bool = False,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Go on with a training that was stopped or killed, to the policies that it would have come to: the same bits.

    It goes on from the newest checkpoint that is whole, or from the beginning when there is none; rows and events after
    that checkpoint are dropped, so that nothing stands twice.

    Args:
        directory: the run's folder.
        measure: as it was given to ``train``.
        stop_when_lost: stop again at the next evaluation that finds the training lost.
        stop_at: as it was given to ``train``; it hears of new evaluations only.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.
        other_versions: go on from a checkpoint that other versions, or other plug-ins, wrote, although its numbers may
            differ.

    Raises ``InvalidInput`` for a folder without a training, one that has finished, one in which another process trains,
    one whose ``config.json`` was edited since the checkpoint, a checkpoint of other versions, and other plug-ins.

    """
    run, config = open_run(Path(directory))
    if not other_versions:
        check_run_plugins(run.path, config, "or go on all the same with --other-versions")
    training = training_in(run.path, config)
    if has_finished(run):
        alone = len(training.drivers) == 1
        agents = f"{training.recipe.algorithm}@{directory}+episode" if alone else f"team@{directory}"
        raise InvalidInput(
            f"{directory}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {training.scenario.name} --agents {agents}"
        )

    def begin() -> tuple[RunDirectory, bool]:
        run.write_json(run.team, team_content(training.scheme, training.scenario))  # a damaged one would stay
        return run, other_versions

    return _run(begin, training, measure, listener(on_progress), stop_when_lost, stop_at)


def _run(
    begin: Callable[[], tuple[RunDirectory, bool | None]],
    training: Training,
    measure: Measure | None,
    on_progress: OnProgress | None,
    stop_when_lost: bool,
    stop_at: StopAt | None,
) -> TrainResult:
    """Train in the folder that ``begin`` makes or finds, once nothing can be wrong with environment and model.

    What else it gives is None for a new training, else whether other versions may go on with it.
    """
    evaluate = None if measure is None else measure(training)
    algorithm = algorithm_named(training.recipe.algorithm)
    with own_random_state(), stop_on_signal() as stop, _environment(training) as environment:
        model = make_model(algorithm, training, environment)
        run, other_versions = begin()
        with only_process(run):
            policy_now = policy_maker(algorithm, training)
            found = None if other_versions is None else _newest(run, training.identity, other_versions)
            if found is not None and found[0] is not None:
                check_fits(run.checkpoints, found[0], model, algorithm, policy_now(model))
            session = Session(run, model, algorithm, training)
            between = BetweenUpdates(
                training.recipe,
                algorithm,
                policy_now,
                save=session.save,
                stop=stop,
                stop_when_lost=stop_when_lost,
                stop_at=stop_at,
                evaluate=evaluate,
                on_progress=on_progress,
            )
            if found is not None:
                session.restore(between, found[0])
                between.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in found[1]]
            status = session.learn(between)
    return _result(run, training, between.course, status)


def _result(run: RunDirectory, training: Training, course: Course, status: Ended) -> TrainResult:
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path,
        training,
        course.kept,
        course.policy,
        status,
        course.steps,
        course.updates,
        course.wall_s,
        tuple(course.evaluations),
        tuple(course.alarms),
    )


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(f"training: {', '.join(trained.members)} have a policy each; take one of policies")


def _newest(run: RunDirectory, training: str, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if not run.checkpoints.is_dir():
        return None, []
    remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is not None:
        if state.numbers["training"] != training:
            name = run.checkpoint(state.steps).name
            raise InvalidInput(
                f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or"
                " train again in another folder"
            )
        if not other_versions:
            _check_versions(run, state.versions)
    return state, damaged


def _check_versions(run: RunDirectory, then: Mapping[str, str]) -> None:
    now = installed_versions()
    for name in sorted(now.keys() | then.keys()):
        if now.get(name) != then.get(name):
            raise InvalidInput(
                f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
                " differ; install that version, or go on all the same with --other-versions"
            )


@contextmanager
def _environment(training: Training) -> Iterator[EthBrakeVecEnv]:
    recipe = training.recipe
    environment = make_sb3_vec_env(
        training.scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=training.observation,
        horizon_is_end=recipe.horizon_is_end,
        appended=_APPENDED.get(training.scheme),
    )
    try:
        yield environment
    finally:
        environment.close()
