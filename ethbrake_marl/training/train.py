"""Train policies, or resume a training: build the model, let it learn, and between updates measure, log and save."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.policies.bundle import save_drivers
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress, Told
from ethbrake_marl.registry import versions_used
from ethbrake_marl.stopping import stop_on_signal
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.finite import FiniteNumbers, TrainingDiverged, check_weights, refuse_gradients
from ethbrake_marl.training.fixed_list import Evaluate, Measure, Policies, deciding, measure_on_list
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe, algorithm_of
from ethbrake_marl.training.run import RunFolder, Status
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.game import AnyScenario, game_of

# Column of the log -> key of ``info`` at the end of an episode: means over the episodes since the last row.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}
APPENDED: dict[Scheme, Any] = {"independent": "number", "centralised": "state"}
DOES_NOT_FIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)

_ONE_TRAINING = threading.Lock()


@dataclass(frozen=True)
class TrainResult:
    """Policies, and how they came about.

    >>> import ethbrake_marl as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')

    """

    directory: Path  # of the run
    training: Training  # recipe and scenario
    policies: Policies  # the best on the fixed list, or the last if nothing was measured; the run's folder ``policy``
    last_policies: Policies  # at the end; ``policy-last``
    status: Literal["finished", "interrupted"]
    steps: int  # decisions of all learners together
    updates: int  # rounds of collecting and learning
    wall_s: float  # time that all processes have spent on this training
    evaluations: tuple[Mapping[str, float], ...]  # steps, updates, metrics and ``cpu_s``, the learning's processor time

    @property
    def agent(self) -> str:
        """Name of the trained agent for ``--agents``: ``policy@runs/mine``."""
        return f"{'policy' if len(self.training.learners) == 1 else 'team'}@{self.directory}"

    @property
    def metrics(self) -> Mapping[str, float] | None:
        """Evaluation of ``policies``; None if nothing was measured."""
        steps = next(iter(self.policies.values())).manifest.steps
        return next((each for each in self.evaluations if each["steps"] == steps), None)

    @property
    def policy(self) -> Policy:
        """The policy that drives all learners. Raises ``InvalidInput`` if each has its own."""
        return _only(self.policies)

    @property
    def last_policy(self) -> Policy:
        """The policy at the end. Raises ``InvalidInput`` if each learner has its own."""
        return _only(self.last_policies)


def train(
    recipe: str | Path | Mapping[str, Any] | TrainingRecipe,
    scenario: AnyScenario,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    turns: int | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    settings: Sequence[str] = (),
    measure: Measure | None = measure_on_list,
    on_progress: Told = "show",
) -> TrainResult:
    """Train the learners of a scenario, and write the folder of the run.

    Ctrl-C stops after the current update (status ``interrupted``), a second one at once. After Ctrl-C or an error
    ``policy/`` has the best policy so far and ``policy-last/`` the latest; ``resume`` goes on. The same recipe, scenario
    and seed lead to the same policy on the same machine, to the bit.

    Args:
        recipe: a recipe, its name, the path of its file, or the content of one.
        scenario: likewise. Its roles say which vehicles learn.
        directory: new folder of the run.
        scheme, turns, seed, steps: other values of the recipe's keys ``scheme``, ``turns``, ``seed``, ``total_steps``.
            A training ends with a whole update, so it may make a few more steps.
        force: replace an earlier run in ``directory``.
        settings: by which recipe and scenario differ from their files, ``KEY=VALUE``; ``config.json`` records them.
        measure: takes a ``Training``, and returns a function that takes policies, learner -> policy, and returns metrics.
            By default these are measured on the recipe's fixed list of worlds; None: nothing is measured. Measured is
            before the first update, every few updates and at the end.
        on_progress: is called with each ``Progress``; ``show``: print it on stderr; None: no reports.

    Raises ``AlreadyExists`` for a directory that exists, ``InvalidInput`` if recipe and scenario do not fit each other
    or another thread is training, ``TrainingDiverged`` if a number is not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{key: value for key, value in changes.items() if value is not None})
    folder = RunFolder(directory)
    with _prepared(training, folder, measure, on_progress) as updates:
        folder.create(training, training.config(settings), force=force)
        with folder.held():
            return _learn(updates, None)


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
    on_progress: Told = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Continue a training that was stopped or killed, from its newest checkpoint, or from the beginning.

    Policies, evaluations and logs are the same as without the interruption, to the bit. Results of ``ethbrake run`` are
    deleted.

    Args:
        directory: folder of the run.
        measure, on_progress: as in ``train``.
        other_versions: accept a checkpoint that other versions of packages, or another physics, have written.

    Raises ``InvalidInput`` if the folder has no training or a finished one, if another process is training in it, if
    ``config.json`` has changed since the checkpoint, or for other versions.

    """
    folder = RunFolder(directory)
    training = folder.training()
    with _prepared(training, folder, measure, on_progress) as updates, folder.held():
        _check_unfinished(folder)
        saved, damaged = checkpoint.newest(folder.checkpoints)
        if saved is not None:
            _check_same(folder, training, saved, other_versions)
        folder.clear()
        folder.write_team(training)  # it may be damaged
        updates.notes += [f"deleted a damaged checkpoint: {reason}" for reason in damaged]
        return _learn(updates, saved)


def _only(policies: Policies) -> Policy:
    first, *others = policies.values()
    if any(other is not first for other in others):
        name = next(iter(policies))
        raise InvalidInput(
            f"training: {', '.join(policies)} have different policies; use the attribute policies, for instance"
            f" policies[{name!r}]"
        )
    return first


@contextmanager
def _prepared(
    training: Training, folder: RunFolder, measure: Measure | None, on_progress: Told
) -> Iterator[BetweenUpdates]:
    """Build environment and model; yield what happens between updates. Nothing is written yet.

    Inside, Ctrl-C asks to stop, and torch has one thread: with networks so small a second one makes training 3 to 15
    times slower if another process uses the cores. At the end the global random generators are as before.
    """
    if not _ONE_TRAINING.acquire(blocking=False):
        raise InvalidInput(
            "train: another thread of this process is training, and both would draw from the same random generators;"
            " wait until it has ended, or train in another process"
        )
    states = random.getstate(), np.random.get_state(), torch.get_rng_state(), torch.get_num_threads()  # noqa: NPY002
    try:
        torch.set_num_threads(1)
        evaluate = None if measure is None else measure(training)
        with stop_on_signal() as stop, closing(make_environment(training)) as environment:
            yield BetweenUpdates(training, folder, environment, evaluate, Progress.listener(on_progress), stop)
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])
        torch.set_num_threads(states[3])
        _ONE_TRAINING.release()


def make_environment(training: Training) -> EthBrakeVecEnv:
    """Return the environment of a training, with one row for each learner in each world."""
    recipe = training.recipe
    scenario, game = game_of(training.scenario, reward=recipe.reward, observation=list(training.row.names))
    appended = APPENDED.get(training.scheme)
    return EthBrakeVecEnv(scenario, game, recipe.n_envs, recipe.seed, recipe.horizon_is_end, appended)


def _learn(updates: BetweenUpdates, saved: Mapping[str, Any] | None) -> TrainResult:
    """Train to the end, or until somebody stops it; save the policies, also after an error."""
    model, training, folder = updates.model, updates.training, updates.folder
    if saved is not None:
        updates.restore(saved)
    folder.write_status("running")
    steps = None if saved is None else updates.steps
    model.logger.output_formats = folder.open_logs("" if saved is None else saved["course"]["progress"], steps)
    status: Literal["finished", "interrupted"] = "finished"
    try:
        model.learn(
            training.recipe.total_steps - model.num_timesteps,
            callback=[FiniteNumbers(), updates],
            log_interval=None,  # type: ignore[arg-type]  # rows are written between updates
            reset_num_timesteps=saved is None,
        )
    except Stopped:
        status = "interrupted"
    except BaseException as error:
        cause = _cause(model, error)
        updates.save("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", cause)
        if cause is error:
            raise
        raise cause from error
    finally:
        model.logger.close()
    updates.save(status)
    assert updates.policies is not None and updates.chosen is not None  # since before the first rollout
    return TrainResult(
        folder.path, training, updates.chosen, updates.policies, status, updates.steps, updates.updates,
        updates.wall_s, tuple(updates.evaluations),
    )  # fmt: skip


def _cause(model: BaseAlgorithm, error: BaseException) -> BaseException:
    """Return ``TrainingDiverged`` for a ValueError of torch about weights that are not finite; else the error."""
    if isinstance(error, ValueError):
        try:
            check_weights(model)
        except TrainingDiverged as diverged:
            return diverged
    return error


class Stopped(Exception):
    """Leaves Stable-Baselines3's loop between two updates."""


class BetweenUpdates(BaseCallback):
    """What happens before the first update, between updates and at the end: measure, log, report, save, stop."""

    model: BaseAlgorithm

    def __init__(
        self,
        training: Training,
        folder: RunFolder,
        environment: EthBrakeVecEnv,
        evaluate: Evaluate | None,
        tell: OnProgress | None,
        stop: Callable[[], bool],
    ) -> None:
        super().__init__()
        self.training, self.folder, self.evaluate, self.tell, self.stop = training, folder, evaluate, tell, stop
        self.algorithm = algorithm_of(training.recipe)
        self.model = self.algorithm.build(training, environment)
        if self.model.get_vec_normalize_env() is not None:
            raise InvalidInput(
                f"algorithm {training.recipe.algorithm!r}: its model uses VecNormalize, whose statistics no policy file"
                " holds; build the model without VecNormalize, since observations are already scaled"
            )
        refuse_gradients(self.model)
        self.model.set_logger(Logger(str(folder.path), []))
        self.steps = self.updates = 0  # of `policies`
        self.policies: Policies | None = None  # the last ones whose weights are finite
        self.best: Policies | None = None  # on the fixed list
        self.best_value = float("inf")
        self.evaluations: list[dict[str, float]] = []
        self.ended: dict[str, list[float]] = {column: [] for column in EPISODE_COLUMNS}
        self.notes: list[str] = []
        self.done_here = False  # after ``restore``: the work after this update was done before the checkpoint
        self.count = 0  # updates so far
        self.wall_start, self.cpu_start = time.monotonic(), time.process_time()

    @property
    def wall_s(self) -> float:
        """Time of this training, without the time between a stop and ``resume``."""
        return time.monotonic() - self.wall_start

    @property
    def chosen(self) -> Policies | None:
        """The result so far."""
        return self.best or self.policies

    def _on_rollout_start(self) -> None:
        if not self.done_here:
            self.between()
        self.done_here = False
        if self.stop():
            self.write_checkpoint()
            raise Stopped

    def _on_step(self) -> bool:
        for row in np.flatnonzero(self.locals["dones"]):
            for column, name in EPISODE_COLUMNS.items():
                self.ended[column].append(float(self.locals["infos"][row][name]))
        return True

    def _on_rollout_end(self) -> None:
        self.count += 1

    def _on_training_end(self) -> None:
        self.between(last=True)

    def between(self, *, last: bool = False) -> None:
        """Do what is due after an update."""
        recipe = self.training.recipe
        measured = self.evaluate is not None and (last or self.count % recipe.evaluation.every_updates == 0)
        if last or measured or self.count % recipe.updates_per_row == 0:
            self.take_policies()
            if measured:
                self.measure()
            self.log_row()
            self.report()
        if not last and self.count and self.count % recipe.checkpoint_every_updates == 0:
            self.write_checkpoint()

    def take_policies(self) -> None:
        """Keep a copy of the current policies. Raises ``TrainingDiverged`` if a weight is not finite."""
        if self.policies is None or (self.steps, self.updates) != (self.model.num_timesteps, self.count):
            check_weights(self.model)
            actors = self.algorithm.actors(self.model)
            self.policies = policies_of(
                self.training, self.model.num_timesteps, lambda k, network: self.algorithm.tensors(actors[k], network)
            )
            self.steps, self.updates = self.model.num_timesteps, self.count

    def measure(self) -> None:
        """Measure the policies, and keep them if they are the best so far."""
        assert self.policies is not None and self.evaluate is not None
        begun = time.process_time()
        metrics = {name: float(value) for name, value in self.evaluate(self.policies).items()}
        spent = {"cpu_s": begun - self.cpu_start}
        self.cpu_start += time.process_time() - begun
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **self.returns(), **spent})
        value = deciding(metrics, self.training.recipe.reward.harm_count)
        if value < self.best_value:
            self.best, self.best_value = self.policies, value
        for name, number in metrics.items():
            self.logger.record(f"eval/{name}", number)

    def log_row(self) -> None:
        """Write a row of the logs."""
        self.logger.record("steps", self.model.num_timesteps, exclude="tensorboard")
        if any(self.ended.values()):
            for column, values in self.ended.items():
                self.logger.record(column, float(np.mean(values)))
        self.ended = {column: [] for column in EPISODE_COLUMNS}
        model: Any = self.model
        if self.count and hasattr(model, "dump_logs"):
            model.dump_logs(*([self.count] if isinstance(model, OnPolicyAlgorithm) else []))
        elif self.count or self.evaluations:
            self.logger.dump(step=model.num_timesteps)

    def returns(self) -> dict[str, float]:
        """Return the mean return of the latest training episodes as ``episode_return``, if there are any."""
        returns = [float(episode["r"]) for episode in self.model.ep_info_buffer or ()]
        return {"episode_return": sum(returns) / len(returns)} if returns else {}

    def report(self) -> None:
        """Report progress."""
        if self.tell is None:
            return
        recipe = self.training.recipe
        metrics = dict(self.evaluations[-1]) if self.evaluations else {}
        if metrics and recipe.reward.harm_count == "total":  # the harm that the reward counts comes first
            metrics = {"total_harm": metrics.get("total_harm", 0.0), **metrics}
        rollout = self.model.n_envs * recipe.rounds
        planned = -(-recipe.total_steps // rollout) * rollout
        note, self.notes = "; ".join(self.notes), []
        self.tell(
            Progress(
                "training", self.steps, planned, {**metrics, **self.returns()}, note, self.updates, self.wall_s,
                "objective",
            )
        )  # fmt: skip

    def write_checkpoint(self) -> None:
        """Write a checkpoint, unless there is one of this moment."""
        self.take_policies()
        if checkpoint.path_of(self.folder.checkpoints, self.steps).exists():
            return
        best = {} if self.best is None else {learners[0]: self.best[learners[0]] for learners in self.training.groups}
        course = {
            "updates": self.updates,
            "evaluations": self.evaluations,
            "best": {name: dict(policy.tensors) for name, policy in best.items()},
            "best_steps": next((policy.manifest.steps for policy in best.values()), 0),
            "best_value": self.best_value,
            "ended": self.ended,
            "wall_s": self.wall_s,
            "cpu_s": time.process_time() - self.cpu_start,
            "progress": self.folder.progress.read_text("utf-8"),
        }
        marks = {"training": self.training.identity, "versions": installed_versions(), "steps": self.steps}
        checkpoint.write(self.folder.checkpoints, {**marks, "course": course, "model": checkpoint.capture(self.model)})

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go on from a checkpoint. Raises ``CorruptBundle`` if it does not fit this training."""
        course = saved["course"]
        try:
            checkpoint.restore(self.model, saved["model"])
            self.count = int(course["updates"])
            self.evaluations = [{name: float(each[name]) for name in each} for each in course["evaluations"]]
            self.ended = {column: [float(each) for each in course["ended"][column]] for column in EPISODE_COLUMNS}
            self.best_value = float(course["best_value"])
            self.wall_start, self.cpu_start = (
                self.wall_start - float(course["wall_s"]), time.process_time() - float(course["cpu_s"]),
            )  # fmt: skip
            self.take_policies()
            if course["best"]:
                names = [learners[0] for learners in self.training.groups]
                self.best = policies_of(
                    self.training,
                    int(course["best_steps"]),
                    lambda k, _: {key: tensor.numpy() for key, tensor in course["best"][names[k]].items()},
                )
            course["progress"].encode()
        except DOES_NOT_FIT as error:
            raise CorruptBundle(
                f"{self.folder.checkpoints}: the checkpoint of step {saved['steps']} does not fit this training:"
                f" {' '.join(str(error).split())}; delete this checkpoint to resume from an earlier one"
            ) from None
        self.done_here = True

    def save(self, status: Status, reason: BaseException | None = None) -> None:
        """Save the policies, and write how the training has ended. A finished one needs no checkpoints any more."""
        for policies, place in ((self.chosen, self.folder.policy), (self.policies, self.folder.last_policy)):
            if policies is not None:
                save_drivers(policies, place, replace=True)
        left = () if status == "finished" else checkpoint.files_in(self.folder.checkpoints)
        chosen = None if self.chosen is None else next(iter(self.chosen.values())).manifest.steps
        self.folder.write_status(
            status,
            reason=None if reason is None else f"{type(reason).__name__}: {reason}",
            wall_s=round(self.wall_s, 3),
            cpu_s={str(int(each["steps"])): round(each["cpu_s"], 3) for each in self.evaluations},
            steps=self.steps,
            updates=self.updates,
            policy_steps=chosen,
            policy=None if chosen is None else self.folder.policy.name,
            checkpoints=[path.name for path in left],
        )
        if status == "finished" and self.folder.checkpoints.is_dir():
            remove_folder(self.folder.checkpoints)


def policies_of(
    training: Training, steps: int, tensors: Callable[[int, NetworkSpec], Mapping[str, Float32s]]
) -> dict[str, Policy]:
    """Return the policy of each learner after ``steps`` decisions: learners of one group share one.

    ``tensors`` takes the number of a group and the networks of its policy, and returns the tensors.
    """
    recipe, scenario = training.recipe, training.scenario
    policies: dict[str, Policy] = {}
    for k, learners in enumerate(training.groups):
        view = training.views[training.learners.index(learners[0])]
        network = recipe.network_spec(len(view.names))
        if training.scheme == "centralised":
            network = network.model_copy(update={"value_hidden": ()})  # a vehicle cannot use the critic
        policy = Policy.make(
            tensors(k, network),
            network=network,
            observation=view,
            algorithm=recipe.algorithm,
            learners=learners,
            scenario=scenario.content(),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=steps,
        )
        policies |= dict.fromkeys(learners, policy)
    return policies


def _check_unfinished(folder: RunFolder) -> None:
    """Raise ``InvalidInput`` if the training has finished, even if ``ethbrake run`` has not evaluated it yet."""
    status = read_object(folder.status)
    if status["status"] == "finished" or (status.get("stage") is not None and not any(folder.checkpoints.glob("*"))):
        raise InvalidInput(
            f"{folder.path}: this training has finished and cannot be resumed; evaluate its policy (ethbrake evaluate)"
        )


def _check_same(folder: RunFolder, training: Training, saved: Mapping[str, Any], other_versions: bool) -> None:
    """Raise ``InvalidInput`` if a checkpoint is of another training, or of other versions of packages."""
    if saved["training"] != training.identity:
        raise InvalidInput(
            f"{folder.config}: this file was changed after the checkpoint of step {saved['steps']} was written; restore"
            " the old content, or train again in another folder"
        )
    now, then = installed_versions(), saved["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # this process may have loaded more parts
    other = sorted(name for name in asked if now.get(name) != then.get(name))
    if other and not other_versions:
        name = other[0]
        raise InvalidInput(
            f"{folder.path}: this training began with {name} {then.get(name)}, but {name} {now.get(name)} is installed"
            " and may compute other numbers; install the old version, or continue anyway (--other-versions)"
        )
