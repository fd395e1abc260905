"""Train: recipe and scenario in, a run's folder with the policies out; or go on with a training that stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, Told, listener
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.files.store import hold_lock, remove_folder, remove_unfinished
from ethbrake_marl.harm import objective_harm
from ethbrake_marl.learning.algorithms import tensors_of
from ethbrake_marl.learning.checkpoint import (
    TrainingState,
    capture_model,
    check_fits,
    newest_usable,
    own_random_state,
    restore_model,
    write_checkpoint,
)
from ethbrake_marl.learning.progress import (
    AT_HORIZON,
    EPISODE_COLUMNS,
    OBJECTIVE,
    RETURN,
    Course,
    EventFile,
    Model,
    ProgressTable,
    TrainingDiverged,
    check_losses,
    check_step,
    check_weights,
    cut_back,
    event_sizes,
    watch_gradients,
    weights_are_finite,
)
from ethbrake_marl.learning.recipe import Scheme, TrainingRecipe, algorithm_named
from ethbrake_marl.learning.training import (
    Algorithm,
    RunDirectory,
    RunStatus,
    Training,
    check_run_plugins,
    create_run,
    has_finished,
    open_run,
    resolve,
    stop_on_signal,
    team_content,
    training_in,
    write_status,
)
from ethbrake_marl.observations import Appended
from ethbrake_marl.policies.actor import installed_versions, observation_schema
from ethbrake_marl.policies.bundle import Policy, PolicyTeam, Trained, drivers_of, make_policy, save_trained, steps_of
from ethbrake_marl.rewards import resolved_objective
from ethbrake_marl.scenario import Scenario

Evaluate = Callable[[Any], Mapping[str, float]]  # of what is trained: a ``Policy``, or a ``PolicyTeam``
StopAt = Callable[[Mapping[str, float]], str | None]  # of an evaluation, a reason to stop there, or None
Measure = Callable[[Training], Evaluate]


Ended = Literal["finished", "interrupted"]


class StopRequested(Exception):
    """Raised inside the training loop to leave it between two updates, for this reason; never seen outside."""

    def __init__(self, reason: str | None = None) -> None:
        super().__init__(reason)
        self.reason = reason


class _Wishes(NamedTuple):
    """What is asked of a training beside its result."""

    evaluate: Evaluate | None
    stop_when_lost: bool
    stop_at: StopAt | None
    on_progress: OnProgress | None


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


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(f"training: {', '.join(trained.members)} have a policy each; take one of policies")


def measure_on_list(training: Training) -> Evaluate:
    """What measures the learners' policies on the recipe's fixed list: the means that ``evaluate`` gives on it.

    These alone: no bound is proven and no best known harm is looked up, as nobody is shown them. Where a learner has
    another objective than total, also what each one's makes of the harm, and the mean of these.
    """
    recipe, scenario = training.recipe, training.scenario
    names = scenario.vehicle_names
    objectives = resolved_objective(recipe.reward, scenario.objective, scenario.vehicles)[1]
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        driver: Driver
        if isinstance(trained, Policy):
            driver = LearnedAgent(trained, "policy")
        else:
            members = trained.members.items()
            driver = Team({names.index(name): LearnedAgent(each, "policy") for name, each in members}, "policy")
        outcome = evaluate(worlds, {"policy": driver}, scenario=scenario, aftermath=False).outcome("policy")
        metrics = {
            "first_impact_harm": mean(outcome.first_impact_harm).value,
            "total_harm": mean(outcome.total_harm).value,
            "collision_rate": float(outcome.collided.mean()),
            AT_HORIZON: float((~outcome.at_rest).mean()),
        }
        if objectives:
            harm = objective_harm(outcome.ledger, recipe.reward.harm_count, objectives)
            each = {names[i]: mean(harm[:, i]).value for i in scenario.learners}
            metrics[OBJECTIVE] = sum(each.values()) / len(each)
            metrics |= {f"{OBJECTIVE}_{name}": value for name, value in each.items()}
        return metrics

    return measure


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

    evaluate = None if measure is None else measure(training)

    def begin() -> tuple[RunDirectory, None]:
        team = team_content(training.scheme, training.scenario)
        config = {**training.config(), **({"settings": list(settings)} if settings else {})}
        return create_run(Path(directory), config, team=team, force=force), None

    return _run(begin, training, _Wishes(evaluate, stop_when_lost, stop_at, listener(on_progress)))


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

    evaluate = None if measure is None else measure(training)

    def begin() -> tuple[RunDirectory, bool]:
        run.write_json(run.team, team_content(training.scheme, training.scenario))  # a damaged one would stay
        return run, other_versions

    return _run(begin, training, _Wishes(evaluate, stop_when_lost, stop_at, listener(on_progress)))


def _run(begin: Callable[[], tuple[RunDirectory, bool | None]], training: Training, wishes: _Wishes) -> TrainResult:
    """Train in the folder that ``begin`` makes or finds, once nothing can be wrong with environment and model.

    What else it gives is None for a new training, else whether other versions may go on with it.
    """
    algorithm = algorithm_named(training.recipe.algorithm)
    with own_random_state(), stop_on_signal() as stop, _environment(training) as environment:
        model = make_model(algorithm, training, environment)
        run, other_versions = begin()
        with hold_lock(run.lock, "another process is training here"):
            state, damaged = (None, []) if other_versions is None else _newest(run, training.identity, other_versions)
            session = Session(run, training, algorithm, model, wishes, stop)
            if state is not None:
                check_fits(run.checkpoints, state, model, algorithm, policy_maker(algorithm, training)(model))
            session.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in damaged]
            status = session.learn(state)
    course = session.course
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path, training, course.kept, course.policy, status, course.steps, course.updates, course.wall_s,
        tuple(course.evaluations), tuple(course.alarms),
    )  # fmt: skip


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
        now, then = installed_versions(), state.versions
        other = sorted(name for name in now.keys() | then.keys() if now.get(name) != then.get(name))
        if other and not other_versions:
            name = other[0]
            raise InvalidInput(
                f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
                " differ; install that version, or go on all the same with --other-versions"
            )
    return state, damaged


class Session(BaseCallback):
    """One stretch of a training in one process: from a fresh model or a checkpoint, to the end or the next stop.

    It keeps the run's folder complete. What is due stands in ``_after_update``, before the first rollout and after each
    update. ``stop`` is asked before every rollout; ``StopRequested`` is raised when it says yes, with everything saved.
    With ``stop_when_lost`` also where the evaluation just before has found the training lost, with ``stop_at`` where
    that gave a reason.
    """

    model: Model

    def __init__(
        self, run: RunDirectory, training: Training, algorithm: Algorithm, model: Model, wishes: _Wishes,
        stop: Callable[[], bool],
    ) -> None:  # fmt: skip
        super().__init__()
        self.run, self.training, self.algorithm, self.model = run, training, algorithm, model
        self.recipe, self._wishes, self._stop = training.recipe, wishes, stop
        self._policy_now = policy_maker(algorithm, training)
        self._table = ProgressTable(run.progress)
        self._reason: str | None = None  # to stop at the next rest
        self.updates = 0
        self.course = Course(self.recipe.reward.harm_count)
        self.notes: list[str] = []  # to be told when the training begins
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._resumed = False  # what is due at this rest was done before the checkpoint was written

    def learn(self, state: TrainingState | None) -> Ended:
        """Train from ``state`` (None: from the beginning) to the end, and leave the folder complete whatever it is."""
        model = self.model
        write_status(self.run, "running", {})
        if state is None:
            self.run.progress.unlink(missing_ok=True)
            cut_back(self.run.tensorboard, {})
        else:
            self._table.restore(state.table)
            cut_back(self.run.tensorboard, state.numbers["events"])
        logger = Logger(str(self.run.path), [self._table, EventFile(self.run.tensorboard)])
        model.set_logger(logger)
        if state is not None:
            self._restore(state)
        status: Ended = "finished"
        reason: str | None = None
        try:
            steps = self.recipe.total_steps - model.num_timesteps
            model.learn(steps, callback=self, log_interval=None, reset_num_timesteps=state is None)  # type: ignore[arg-type]
        except StopRequested as stop:
            status, reason = "interrupted", stop.reason
        except BaseException as error:
            cause = self._explain(error)
            ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._close(ended, f"{type(cause).__name__}: {cause}")
            if cause is error:
                raise
            raise cause from error
        finally:
            logger.close()
        self._close(status, reason)
        return status

    def _restore(self, state: TrainingState) -> None:
        """Bring model and course back to a checkpoint."""
        restore_model(self.model, self.algorithm, state)
        content = state.numbers["between"]
        self.updates = self.course.updates = int(content["updates"])
        self._ended = {column: list(content["ended"][column]) for column in EPISODE_COLUMNS}
        self.course.restore(content["course"])
        self.course.steps, self.course.policy, self.course.best = state.steps, state.policy, state.best
        self._resumed = True

    def _on_rollout_start(self) -> None:
        while self.notes:
            self.tell(self.notes.pop(0))
        if not self._resumed:
            self._after_update()
        self._resumed = False
        lost = self.course.lost if self._wishes.stop_when_lost else None
        reason = lost or self._reason
        if self._stop() or reason is not None:
            self._rest()
            self._save()
            raise StopRequested(reason)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        check_step(self.model, self.locals["rewards"], self.locals["new_obs"])
        for row in np.flatnonzero(self.locals["dones"]):
            for column, name in EPISODE_COLUMNS.items():
                self._ended[column].append(float(infos[row][name]))
        return True

    def _on_rollout_end(self) -> None:
        self.updates += 1

    def _on_training_end(self) -> None:
        self._after_update(last=True)

    def _after_update(self, *, last: bool = False) -> None:
        """Do what is due at this rest, the checkpoint after all the rest of it."""
        check_losses(self.model)
        updates, recipe = self.updates, self.recipe
        measure = self._wishes.evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % recipe.logged_updates == 0:
            self._rest()
            if measure:
                self._measure()
            self._log()
        if not last and updates and updates % recipe.checkpoint_every_updates == 0:
            self._rest()
            self._save()

    def _rest(self) -> None:
        """Bring the course to this moment."""
        course = self.course
        if course.policy is None or (course.steps, course.updates) != (self.model.num_timesteps, self.updates):
            check_weights(self.model, self.algorithm)
            course.policy = self._policy_now(self.model)
            course.steps, course.updates = self.model.num_timesteps, self.updates

    def _measure(self) -> None:
        assert self.course.policy is not None and self._wishes.evaluate is not None
        metrics = {name: float(value) for name, value in self._wishes.evaluate(self.course.policy).items()}
        alarm = self.course.add_evaluation(self.course.policy, metrics, self._recent_return())
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        self.logger.record("eval/alarm", int(alarm is not None))
        if alarm is not None:
            self.tell(f"alarm: {alarm}")
        if self._wishes.stop_at is not None:
            self._reason = self._wishes.stop_at(self.course.evaluations[-1])

    def _recent_return(self) -> float | None:
        episodes = self.model.ep_info_buffer or ()
        return sum(float(e["r"]) for e in episodes) / len(episodes) if episodes else None

    def _log(self) -> None:
        if any(self._ended.values()):
            for column, values in self._ended.items():
                self.logger.record(column, float(np.mean(values)))
        self._ended = {column: [] for column in EPISODE_COLUMNS}
        if self.updates and isinstance(self.model, OnPolicyAlgorithm):
            self.model.dump_logs(self.updates)
        elif self.updates and isinstance(self.model, OffPolicyAlgorithm):
            self.model.dump_logs()
        elif self.updates or self.course.evaluations:
            self.logger.dump(step=self.model.num_timesteps)
        self.tell()

    def tell(self, note: str = "") -> None:
        """Report how far the training is."""
        if self._wishes.on_progress is None:
            return
        course = self.course
        metrics = dict(course.evaluations[-1]) if course.evaluations else {}
        recent = self._recent_return()
        if recent is not None:
            metrics[RETURN] = recent
        rollout = self.model.n_envs * self.recipe.rounds
        planned = -(-self.recipe.total_steps // rollout) * rollout  # whole rollouts
        self._wishes.on_progress(
            Progress("training", course.steps, planned, metrics, note, course.updates, course.wall_s)
        )

    def _save(self) -> None:
        """Write a checkpoint of this moment, unless there is one, and delete those that are old."""
        course, folder = self.course, self.run.checkpoint(self.course.steps)
        if folder.exists():
            return
        assert course.policy is not None
        arrays, numbers, replay = capture_model(self.model, self.algorithm)
        numbers |= {
            "training": self.training.identity,
            "between": {"updates": self.updates, "ended": self._ended, "course": course.to_json()},
            "events": event_sizes(self.run.tensorboard),
        }
        table, versions = self._table.content(), installed_versions()
        write_checkpoint(
            folder,
            TrainingState(
                course.steps, course.updates, numbers, arrays, replay, course.policy, course.best, table, versions
            ),
        )

    def _close(self, status: RunStatus, reason: str | None) -> None:
        """Save the best and the last good policy, say how the run ended; a finished one needs no checkpoint."""
        course, run = self.course, self.run
        for policy, folder in ((course.kept, run.policy), (course.policy, run.last_policy)):
            if policy is not None:
                save_trained(policy, folder, replace=True)
        left_over = () if status == "finished" else run.checkpoints.glob("step_*")
        told = {
            "reason": reason,
            "wall_s": round(course.wall_s, 3),
            "steps": course.steps,
            "updates": course.updates,
            "policy_steps": None if course.kept is None else steps_of(course.kept),
            "alarms": course.alarms,
            "policy": run.policy.name if run.policy.is_dir() else None,
            "checkpoints": sorted(path.name for path in left_over),
        }
        write_status(run, status, told)
        if status == "finished" and run.checkpoints.is_dir():
            remove_folder(run.checkpoints)

    def _explain(self, error: BaseException) -> BaseException:
        """The error to report: torch's own when a distribution gets a NaN says little about a training."""
        if isinstance(error, ValueError) and not weights_are_finite(self.model, self.algorithm):
            return TrainingDiverged(
                f"training: a weight or the exploration noise is not finite at step {self.model.num_timesteps};"
                " try a smaller learning_rate"
            )
        return error


# From a training to its environment, its model, and from a model's present weights to policies.

_APPENDED: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}


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
