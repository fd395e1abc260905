"""Train: recipe and scenario in, a run's folder with the policies out; or go on with a training that stopped."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import hold_lock, remove_folder, remove_unfinished
from ethbrake_marl.game.objectives import objective_harm
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.network import Policy
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.progress import OnProgress, Progress, Told
from ethbrake_marl.registry import versions_used
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.stopping import stop_on_signal
from ethbrake_marl.training.checkpoint import TrainingState, newest_usable, write_checkpoint
from ethbrake_marl.training.models import (
    Model,
    TrainingDiverged,
    make_environment,
    make_model,
    make_policies,
    open_logs,
    weights_are_finite,
)
from ethbrake_marl.training.networks import tensors_of
from ethbrake_marl.training.progress import AT_HORIZON, EPISODE_COLUMNS, LOSSES, RETURN, Course, objective_in_words
from ethbrake_marl.training.random_state import capture_model, check_counter, group_of, own_random_state, restore_model
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe
from ethbrake_marl.training.run_folder import Algorithm, RunDirectory, RunStatus, Training

Evaluate = Callable[[Any], Mapping[str, float]]  # of what is trained: a ``Policy``, or a ``PolicyTeam``

StopAt = Callable[[Mapping[str, float]], str | None]  # of an evaluation, a reason to stop there, or None

Measure = Callable[[Training], Evaluate]

Ended = Literal["finished", "interrupted"]


class StopRequested(Exception):
    """Raised inside the training loop, with its reason, to leave it between two updates; never seen outside."""


class _Wishes(NamedTuple):
    """What is asked of a training beside its result."""

    measure: Measure | None
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

    @property
    def policies(self) -> dict[str, Policy]:
        """Vehicle -> the policy that drives it."""
        return dict(self.trained.drivers)

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
    raise InvalidInput(f"training: {', '.join(trained.drivers)} have a policy each; take one of policies")


def measure_on_list(training: Training) -> Evaluate:
    """What measures the learners' policies on the recipe's fixed list: the means that ``evaluate`` gives on it.

    These alone: no bound is proven and no best known harm is looked up, as nobody is shown them. Where a learner has
    another objective than total, also what each one's makes of the harm, and the mean of these.
    """
    recipe, scenario = training.recipe, training.scenario
    names = scenario.vehicle_names
    objectives = recipe.reward.settled(scenario.objective, scenario.vehicles)[1]
    worlds = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)

    def measure(trained: Trained) -> dict[str, float]:
        driver: Driver = (
            LearnedAgent(trained, "policy")
            if isinstance(trained, Policy)
            else Team({names.index(name): LearnedAgent(p, "policy") for name, p in trained.drivers.items()}, "policy")
        )
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
            metrics[RunDirectory.OBJECTIVE] = sum(each.values()) / len(each)
            metrics |= {f"{RunDirectory.OBJECTIVE}_{name}": value for name, value in each.items()}
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
        turns: overrides the recipe's, of independent learners (docs/training-schemes.md).
        seed: overrides the recipe's.
        steps: overrides the recipe's decisions of learners; training ends after the first update at or beyond them.
        force: replace an earlier run.
        settings: by which recipe and scenario differ from their files, ``KEY=VALUE`` each: noted in ``config.json``.
        measure: makes of the training what measures its policies before the first update, then as the recipe says, and
            at the end: by default on the recipe's fixed list. None: nothing is measured.
        stop_at: is given every evaluation, as it stands in ``TrainResult.evaluations``, and gives a reason to stop
            there, ``interrupted``, or None.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.

    Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` where recipe and scenario do
    not fit each other, ``TrainingDiverged`` for numbers that are not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{name: value for name, value in changes.items() if value is not None})
    run = RunDirectory(Path(directory))
    begin = partial(run.create, training.config(settings), team=training.team(), force=force)
    return _run(run, begin, training, _Wishes(measure, stop_at, Progress.listener(on_progress)))


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
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
        stop_at: as it was given to ``train``; it hears of new evaluations only.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.
        other_versions: go on from a checkpoint that other versions wrote, although its numbers may differ.

    Raises ``InvalidInput`` for a folder without a training, one that has finished, one in which another process trains,
    one whose ``config.json`` was edited since the checkpoint, and a checkpoint of other versions.

    """
    run = RunDirectory(Path(directory))
    config = run.read_config()
    training = run.training(config)
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    if status["status"] == "finished" or (status.get("stage") is not None and not resumable):  # its report may be open
        alone = len(training.drivers) == 1
        agents = f"{training.recipe.algorithm}@{directory}+episode" if alone else f"team@{directory}"
        raise InvalidInput(
            f"{directory}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {training.scenario.name} --agents {agents}"
        )

    begin = partial(run.write_json, run.team, training.team())  # a damaged one would stay
    wishes = _Wishes(measure, stop_at, Progress.listener(on_progress))
    return _run(run, begin, training, wishes, partial(_newest, run, training.identity, other_versions))


def _run(
    run: RunDirectory,
    begin: Callable[[], object],
    training: Training,
    wishes: _Wishes,
    find: Callable[[], tuple[TrainingState | None, list[str]]] = lambda: (None, []),
) -> TrainResult:
    """Train in the folder that ``begin`` makes or mends, once nothing can be wrong with environment and model.

    ``find`` gives the checkpoint to go on from, if there is one, and why newer ones are not whole.
    """
    evaluate = None if wishes.measure is None else wishes.measure(training)
    algorithm = training.recipe.make_algorithm()
    with own_random_state(), stop_on_signal() as stop, closing(make_environment(training)) as environment:
        model = make_model(algorithm, training, environment)
        begin()
        with hold_lock(run.lock, "another process is training here"):
            state, damaged = find()
            session = Session(run, training, algorithm, model, wishes, evaluate, stop)
            if state is not None:
                session.restore(state)
            if state is None and training.begins is not None:
                session.notes.append(f"begins with {training.begins}")
            session.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in damaged]
            status = session.learn(state)
    course = session.course
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path, training, course.kept, course.policy, status, course.steps, course.updates, course.wall_s,
        tuple(course.evaluations),
    )  # fmt: skip


def _newest(run: RunDirectory, training: str, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if run.checkpoints.is_dir():
        remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is None:
        return None, damaged
    if state.numbers.get("training") != training:
        name = run.checkpoint(state.steps).name
        raise InvalidInput(
            f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or"
            " train again in another folder"
        )
    now, then = installed_versions(), state.numbers["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # other parts may have been loaded here since
    other = sorted(name for name in asked if now.get(name) != then.get(name))
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
    The same where ``stop_at`` gave a reason at the evaluation just before.
    """

    model: Model

    def __init__(
        self, run: RunDirectory, training: Training, algorithm: Algorithm, model: Model, wishes: _Wishes,
        evaluate: Evaluate | None, stop: Callable[[], bool],
    ) -> None:  # fmt: skip
        super().__init__()
        self.run, self.training, self.algorithm, self.model = run, training, algorithm, model
        self.recipe, self._wishes, self._evaluate, self._stop = training.recipe, wishes, evaluate, stop
        model.set_logger(Logger(str(run.path), []))
        self._reason: str | None = None  # to stop at the next rest
        self.updates = 0
        self.course = Course(self.recipe.reward.harm_count)
        self.notes: list[str] = []  # to be told when the training begins
        self._objective = objective_in_words(training)
        self._ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self._resumed = False  # what is due at this rest was done before the checkpoint was written

    def restore(self, state: TrainingState) -> None:
        """Bring model and course to ``state``; raises ``CorruptBundle`` where that is of another model."""
        numbers, course = state.numbers, self.course
        try:
            restore_model(self.model, self.algorithm, state)
            for name in ("steps", "updates"):
                check_counter(name, numbers[name], int)
            self.updates = numbers["updates"]
            self._ended = {column: [float(each) for each in numbers["ended"][column]] for column in EPISODE_COLUMNS}
            course.restore(numbers["course"])
            self._rest()
            if numbers["best_steps"] is not None:
                best = partial(group_of, state.arrays)
                course.best = make_policies(self.training, numbers["best_steps"], lambda k, _: best(f"best.{k}."))
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise CorruptBundle(
                f"{self.run.checkpoints}: the checkpoint of step {state.steps} is not of this training:"
                f" {' '.join(str(error).split())}; delete it to go on from the one before"
            ) from None
        self._resumed = True

    def learn(self, state: TrainingState | None) -> Ended:
        """Train from ``state`` (None: from the beginning) to the end, and leave the folder complete whatever it is."""
        model, logger = self.model, self.model.logger
        self.run.write_status("running", start=self.training.begins)
        logger.output_formats = open_logs(self.run, state)
        status: Ended = "finished"
        reason: str | None = None
        try:
            steps = self.recipe.total_steps - model.num_timesteps
            model.learn(steps, callback=self, log_interval=None, reset_num_timesteps=state is None)  # type: ignore[arg-type]
        except StopRequested as stop:
            status, reason = "interrupted", stop.args[0]
        except BaseException as error:
            cause = error  # torch's own when a distribution gets a NaN says little about a training
            if isinstance(error, ValueError) and not weights_are_finite(model, self.algorithm):
                cause = TrainingDiverged(
                    f"training: a weight or the exploration noise is not finite at step {model.num_timesteps};"
                    " try a smaller learning_rate"
                )
            ended: RunStatus = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._close(ended, f"{type(cause).__name__}: {cause}")
            if cause is error:
                raise
            raise cause from error
        finally:
            logger.close()
        self._close(status, reason)
        return status

    def _on_rollout_start(self) -> None:
        while self.notes:
            self.tell(self.notes.pop(0))
        if not self._resumed:
            self._after_update()
        self._resumed = False
        if self._stop() or self._reason is not None:
            self._rest()
            self._save()
            raise StopRequested(self._reason)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        for name, entries in (("observations", self.locals["new_obs"]), ("rewards", self.locals["rewards"])):
            good = np.isfinite(entries)
            if not good.all():
                row = np.argwhere(~good)[0][0]
                raise TrainingDiverged(
                    f"training: {name}[row {row}] = {entries[~good][0]} at step {self.model.num_timesteps}: must be"
                    " finite; the environment or its reward is at fault"
                )
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
        logged = self.logger.name_to_value  # train/loss, or vehicle_2/loss where learners are independent
        for name in (name for loss in LOSSES for name in logged if name.rpartition("/")[2] == loss):
            if not np.isfinite(logged[name]):  # it may well leave finite weights
                raise TrainingDiverged(
                    f"training: {name} = {float(logged[name])} after step {self.model.num_timesteps}: must be finite;"
                    " try a smaller learning_rate, or smaller weights of the reward"
                )
        updates, recipe = self.updates, self.recipe
        measure = self._evaluate is not None and (last or updates % recipe.evaluation.every_updates == 0)
        if last or measure or updates % getattr(recipe, "log_every_updates", 1) == 0:
            self._rest()
            if measure:
                self._measure()
            self.logger.record("steps", self.model.num_timesteps, exclude="tensorboard")
            if any(self._ended.values()):
                for column, values in self._ended.items():
                    self.logger.record(column, float(np.mean(values)))
            self._ended = {column: [] for column in EPISODE_COLUMNS}
            if updates and isinstance(self.model, OnPolicyAlgorithm):
                self.model.dump_logs(updates)
            elif updates and isinstance(self.model, OffPolicyAlgorithm):
                self.model.dump_logs()
            elif updates or self.course.evaluations:
                self.logger.dump(step=self.model.num_timesteps)
            self.tell()
        if not last and updates and updates % recipe.checkpoint_every_updates == 0:
            self._rest()
            self._save()

    def _rest(self) -> None:
        """Bring the course to this moment."""
        course = self.course
        if course.policy is None or (course.steps, course.updates) != (self.model.num_timesteps, self.updates):
            if not weights_are_finite(self.model, self.algorithm):
                raise TrainingDiverged(f"training: a weight is not finite after step {self.model.num_timesteps}")
            actors = self.algorithm.actors(self.model)
            course.policy = make_policies(
                self.training, self.model.num_timesteps, lambda k, network: tensors_of(actors[k], network)
            )
            course.steps, course.updates = self.model.num_timesteps, self.updates

    def _measure(self) -> None:
        assert self.course.policy is not None and self._evaluate is not None
        begun = time.process_time()
        metrics = {name: float(value) for name, value in self._evaluate(self.course.policy).items()}
        self.course.cpu_started += time.process_time() - begun
        self.course.add_evaluation(self.course.policy, metrics, self._recent_return())
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        if self._wishes.stop_at is not None:
            self._reason = self._wishes.stop_at(self.course.evaluations[-1])

    def _recent_return(self) -> float | None:
        episodes = self.model.ep_info_buffer or ()
        return sum(float(e["r"]) for e in episodes) / len(episodes) if episodes else None

    def tell(self, note: str = "") -> None:
        """Report how far the training is."""
        if self._wishes.on_progress is None:
            return
        course = self.course
        metrics = dict(course.evaluations[-1]) if course.evaluations else {}
        if metrics and self.recipe.reward.harm_count == "total":  # what is trained for stands first
            metrics = {"total_harm": metrics["total_harm"], **metrics}
        recent = self._recent_return()
        if recent is not None:
            metrics[RETURN] = recent
        rollout = self.model.n_envs * self.recipe.rounds
        planned = -(-self.recipe.total_steps // rollout) * rollout  # whole rollouts
        self._wishes.on_progress(
            Progress("training", course.steps, planned, metrics, note, course.updates, course.wall_s, self._objective)
        )

    def _save(self) -> None:
        """Write a checkpoint of this moment, unless there is one, and delete those that are old."""
        course, folder = self.course, self.run.checkpoint(self.course.steps)
        if folder.exists():
            return
        numbers, arrays = capture_model(self.model, self.algorithm)
        numbers |= {
            "training": self.training.identity,
            "versions": installed_versions(),
            "steps": course.steps,
            "updates": course.updates,
            "ended": self._ended,
            "course": course.to_json(),
            "best_steps": None if course.best is None else course.best.steps,
            "progress": self.run.progress.read_text("utf-8"),
        }
        if course.best is not None:
            best = (course.best,) if isinstance(course.best, Policy) else course.best.drivers.values()
            for k, policy in enumerate(best):
                arrays |= {f"best.{k}.{name}": tensor for name, tensor in policy.tensors.items()}
        write_checkpoint(folder, TrainingState(numbers, arrays))

    def _close(self, status: RunStatus, reason: str | None) -> None:
        """Save the best and the last good policy, say how the run ended; a finished one needs no checkpoint."""
        course, run = self.course, self.run
        for policy, folder in ((course.kept, run.policy), (course.policy, run.last_policy)):
            if policy is not None:
                policy.save(folder, replace=True)
        left_over = () if status == "finished" else run.checkpoints.glob("step_*")
        told = {
            "start": self.training.begins,
            "reason": reason,
            "wall_s": round(course.wall_s, 3),
            "cpu_s": {str(steps): round(spent, 3) for steps, spent in course.cpu_s.items()},
            "steps": course.steps,
            "updates": course.updates,
            "policy_steps": None if course.kept is None else course.kept.steps,
            "policy": run.policy.name if run.policy.is_dir() else None,
            "checkpoints": sorted(path.name for path in left_over),
        }
        run.write_status(status, **told)
        if status == "finished" and run.checkpoints.is_dir():
            remove_folder(run.checkpoints)
