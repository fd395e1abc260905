"""``eb.train`` and ``eb.resume``: train policies, or resume a training."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.interrupts import stop_on_signal
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import Progress, ProgressOption
from ethbrake_marl.registry import versions_used
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.fixed_list import Policies, PolicyMeasure, measure_on_list
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe, algorithm_of
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.training import Training, check_new_run
from ethbrake_marl.training.updates import BetweenUpdates, Stopped, check_finite_model
from ethbrake_marl.worlds.open_game import AnyScenario

APPENDED: dict[Scheme, Any] = {"independent": "number", "centralised": "state"}
_ONE_TRAINING = threading.Lock()


@dataclass(frozen=True)
class TrainResult:
    """The trained policies, and how the training went.

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
        """Such as ``policy@runs/mine``."""
        return agent_of(self.training, self.directory)

    @property
    def metrics(self) -> Mapping[str, float] | None:
        """None if nothing was measured."""
        steps = next(iter(self.policies.values())).manifest.steps
        return next((evaluation for evaluation in self.evaluations if evaluation["steps"] == steps), None)

    @property
    def policy(self) -> Policy:
        """The policy of all learners. Raises ``InvalidInput`` if they have different ones."""
        return _shared_policy(self.policies)

    @property
    def last_policy(self) -> Policy:
        """The policy of all learners at the end. Raises ``InvalidInput`` if they have different ones."""
        return _shared_policy(self.last_policies)


def train(
    recipe: str | Path | Mapping[str, Any] | TrainingRecipe,
    scenario: AnyScenario,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    settings: Sequence[str] = (),
    measure: PolicyMeasure | None = measure_on_list,
    on_progress: ProgressOption = "show",
) -> TrainResult:
    """Train the learners of a scenario, and write the folder of the run.

    Ctrl-C stops after the current update (status ``interrupted``); a second Ctrl-C stops at once. After a stop or an
    error, ``policy/`` has the best policy so far and ``policy-last/`` the latest; ``resume`` continues. The same
    recipe, scenario and seed give the same policy on the same machine, to the bit.

    Args:
        recipe: a recipe, its name, the path of its file, or a file's content.
        scenario: a scenario, in any of the same forms. Its roles say which vehicles learn.
        directory: new folder of the run.
        scheme: how several learners train together; None: as in the recipe.
        seed: seed of worlds, networks and exploration; None: as in the recipe.
        steps: decisions of all learners together, rounded up to whole updates; None: as in the recipe.
        force: replace an earlier run in ``directory``.
        settings: changes of recipe and scenario files, ``KEY=VALUE``; only recorded, in ``config.json``.
        measure: function that takes a ``Training`` and returns a function from policies (learner -> policy) to metrics,
            which is called before the first update, every few updates and at the end. Default: measure on the recipe's
            fixed list of worlds; None: never measure.
        on_progress: function that is called with each ``Progress``; ``show``: print it on stderr; None: no reports.

    Raises ``AlreadyExists`` for a directory that exists, ``InvalidInput`` if recipe and scenario do not fit each
    other, another thread is training or the directory has a comma or a plus, ``TrainingDiverged`` if a loss or a
    weight is not finite.

    """
    changes = {"scheme": scheme, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{key: value for key, value in changes.items() if value is not None})
    folder = RunFolder(directory)
    check_new_run(folder.path, force=force)
    with _one_training() as stop, closing(make_environment(training)) as environment:
        evaluate = None if measure is None else measure(training)
        model = make_model(training, environment)
        updates = BetweenUpdates(model, training, folder, evaluate, Progress.listener(on_progress), stop)
        folder.create(training.config(settings), force=force)
        with folder.held():
            return _learn(updates, None)


def resume(
    directory: str | Path,
    *,
    measure: PolicyMeasure | None = measure_on_list,
    on_progress: ProgressOption = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Continue a stopped or killed training from its newest checkpoint, or from the beginning if there is none.

    Policies, evaluations and logs have the same bits as without the interruption. Results of ``ethbrake run`` are
    deleted.

    Args:
        directory: folder of the run.
        measure: as in ``train``.
        on_progress: as in ``train``.
        other_versions: accept a checkpoint of other versions of packages, or of another physics.

    Raises ``InvalidInput`` if the folder has no training or a finished one, if another process is training in it, if
    ``config.json`` has changed since the checkpoint, or if versions differ without ``other_versions``.

    """
    folder = RunFolder(directory)
    training = folder.training()
    with _one_training() as stop, closing(make_environment(training)) as environment, folder.held():
        evaluate = None if measure is None else measure(training)
        model = make_model(training, environment)
        updates = BetweenUpdates(model, training, folder, evaluate, Progress.listener(on_progress), stop)
        _check_unfinished(folder, training)
        saved, damaged = checkpoint.newest_checkpoint(folder.checkpoints)
        if saved is not None:
            _check_same(folder, training, saved, other_versions)
        folder.clear()
        updates.note = "; ".join(f"deleted a damaged checkpoint: {reason}" for reason in damaged)
        return _learn(updates, saved)


def agent_of(training: Training, directory: Path) -> str:
    return f"{'policy' if len(training.learners) == 1 else 'team'}@{directory}"


def _shared_policy(policies: Policies) -> Policy:
    first, *rest = policies.values()
    if any(policy is not first for policy in rest):
        name = next(iter(policies))
        raise InvalidInput(
            f"training: {', '.join(policies)} have different policies; use the attribute policies, for instance"
            f" policies[{name!r}]"
        )
    return first


@contextmanager
def _one_training() -> Iterator[Callable[[], bool]]:
    """Inside the block, Ctrl-C only sets the flag that the yielded function returns, and torch has its usual type and
    device and one thread: a second thread makes training 3 to 15 times slower if another process uses the cores.
    """
    if not _ONE_TRAINING.acquire(blocking=False):
        raise InvalidInput(
            "train: another thread of this process is training, and both would draw from the same random generators;"
            " wait until it has ended, or train in another process"
        )
    states = random.getstate(), np.random.get_state(), torch.get_rng_state(), torch.get_num_threads()  # noqa: NPY002
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    usual = nullcontext() if device.type == "cpu" else torch.device("cpu")  # which costs time in every call of torch
    try:
        torch.set_num_threads(1)
        torch.set_default_dtype(torch.float32)
        with usual, stop_on_signal() as stop:
            yield stop
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])
        torch.set_num_threads(states[3])
        torch.set_default_dtype(dtype)
        _ONE_TRAINING.release()


def make_environment(training: Training) -> EthBrakeVecEnv:
    """One row for each learner in each world."""
    recipe = training.recipe
    scenario, game = open_game(training.scenario, reward=recipe.reward, observation=list(training.row.names))
    appended = APPENDED.get(training.scheme)
    return EthBrakeVecEnv(scenario, game, recipe.n_envs, recipe.seed, recipe.horizon_is_end, appended)


def make_model(training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
    """Raises ``InvalidInput`` for VecNormalize."""
    model: BaseAlgorithm = algorithm_of(training.recipe).build(training, environment)
    if model.get_vec_normalize_env() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model uses VecNormalize, whose statistics no policy file"
            " holds; build the model without VecNormalize, since observations are already scaled"
        )
    return model


def _learn(updates: BetweenUpdates, saved: Mapping[str, Any] | None) -> TrainResult:
    """Saves the policies, also after an error.

    ``saved``: checkpoint from which the training continues; None: begin.
    """
    model, training, folder = updates.model, updates.training, updates.folder
    model.set_logger(Logger(str(folder.path), []))
    if saved is not None:
        updates.restore(saved)
    folder.write_status("running", reason=None, stage=None, written=[])
    progress, steps = ("", None) if saved is None else (saved["course"]["progress"], saved["steps"])
    model.logger.output_formats = folder.open_logs(progress, steps)
    status: Literal["finished", "interrupted"] = "finished"
    try:
        try:
            model.learn(
                training.recipe.total_steps - model.num_timesteps,
                callback=updates,
                log_interval=None,  # type: ignore[arg-type]  # rows are written between updates
                reset_num_timesteps=saved is None,
            )
        except ValueError:  # torch's, of weights that are not finite, says nothing to a user
            check_finite_model(model)
            raise
    except Stopped:
        status = "interrupted"
    except BaseException as error:
        updates.save("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", error)
        raise
    finally:
        model.logger.close()
    updates.save(status)
    return TrainResult(
        folder.path, training, updates.chosen, updates.policies, status, updates.steps, updates.updates,
        updates.wall_s, tuple(updates.evaluations),
    )  # fmt: skip


def _check_unfinished(folder: RunFolder, training: Training) -> None:
    status = read_object(folder.status)
    if status["status"] == "finished" or (status.get("stage") is not None and not any(folder.checkpoints.glob("*"))):
        raise InvalidInput(
            f"{folder.path}: this training has finished and cannot be resumed; evaluate its policy with: ethbrake"
            f" evaluate --scenario {training.scenario.name} --agents"
            f" full_brake,{agent_of(training, folder.path)}"
        )


def _check_same(folder: RunFolder, training: Training, saved: Mapping[str, Any], other_versions: bool) -> None:
    if saved["training"] != training.identity:
        raise InvalidInput(
            f"{folder.config}: this file was changed after the checkpoint of step {saved['steps']} was written; restore"
            " the old content, or train again in another folder"
        )
    now, then = installed_versions(), saved["versions"]
    packages = then.keys() | (now.keys() - versions_used().keys())  # this process may have loaded more parts
    changed_packages = sorted(name for name in packages if now.get(name) != then.get(name))
    if changed_packages and not other_versions:
        name = changed_packages[0]
        raise InvalidInput(
            f"{folder.path}: this training began with {name} {then.get(name)}, but {name} {now.get(name)} is installed"
            " and may compute other numbers; install the old version, or continue anyway (--other-versions)"
        )
