"""What happens between two updates of a training: measure, log, report, keep the best policies, write checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.policies.bundle import save_drivers
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.finite import check_weights, refuse_gradients
from ethbrake_marl.training.fixed_list import Evaluate, Policies, deciding
from ethbrake_marl.training.recipe import algorithm_of
from ethbrake_marl.training.run import RunFolder, Status
from ethbrake_marl.training.training import Training

# Column of the log -> key of ``info`` at the end of an episode: means over the episodes since the last row.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}
DOES_NOT_FIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


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
        if "total_harm" in metrics and recipe.reward.harm_count == "total":  # what is counted comes first
            metrics = {"total_harm": metrics["total_harm"], **metrics}
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
            self.evaluations = [{name: value + 0 for name, value in each.items()} for each in course["evaluations"]]
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
