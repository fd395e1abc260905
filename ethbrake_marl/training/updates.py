"""Work between two updates of a training: measure, log, report, keep the best policies, write checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from ethbrake_marl.errors import CorruptBundle, EthBrakeError
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.policies.bundle import save_drivers
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.fixed_list import Evaluate, Policies, deciding
from ethbrake_marl.training.recipe import algorithm_of
from ethbrake_marl.training.run import RunFolder, Status
from ethbrake_marl.training.training import Training
from ethbrake_marl.training.training_range import with_ranges


class Stopped(Exception):
    """Ends Stable-Baselines3's training loop between two updates."""


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A loss, a weight or the exploration noise is not finite. The last finite policy is saved."""


class BetweenUpdates(BaseCallback):
    """``evaluate``: function from policies to metrics; ``tell``: function called with the progress; ``stop``: whether
    the training must stop.
    """

    model: BaseAlgorithm

    def __init__(
        self,
        model: BaseAlgorithm,
        training: Training,
        folder: RunFolder,
        evaluate: Evaluate | None,
        tell: OnProgress | None,
        stop: Callable[[], bool],
    ) -> None:
        super().__init__()
        self.model, self.training, self.folder = model, training, folder
        self.evaluate, self.tell, self.stop = evaluate, tell, stop
        self.count = 0  # updates so far
        self.weights: Sequence[Mapping[str, Float32s]] = []  # the latest finite weights, of each group's policy
        self.steps = self.updates = 0  # decisions and updates when `weights` were copied
        self.policies: Policies = {}  # made of `weights` when they are measured or saved
        self.best: Policies = {}  # best policies on the fixed list; empty if nothing was measured
        self.best_value = math.inf  # the metric of `best`
        self.evaluations: list[dict[str, float]] = []
        self.note = ""  # text for the next progress report
        self.restored = False  # True just after `restore`: this update's work was done before the checkpoint
        self.wall_start, self.cpu_start = time.monotonic(), time.process_time()

    @property
    def wall_s(self) -> float:
        """Without breaks before ``resume``."""
        return time.monotonic() - self.wall_start

    @property
    def chosen(self) -> Policies:
        return self.best or self.policies

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Raises ``Stopped`` if the training must stop."""
        due = bool(self.count) and self.count % self.training.recipe.checkpoint_every_updates == 0
        if self.restored:
            self.restored = due = False
        else:
            self.work()
        stopping = self.stop()
        if due or stopping:
            self.write_checkpoint()
        if stopping:  # the checkpoint does not contain this measurement, so a resumed training has the same bits
            self.keep_weights()
            if self.evaluate is not None and self.evaluations[-1]["steps"] != self.steps:
                self.make_policies()
                self.measure()
            raise Stopped

    def _on_rollout_end(self) -> None:
        self.count += 1

    def _on_training_end(self) -> None:
        self.work(last=True)

    def work(self, *, last: bool = False) -> None:
        recipe = self.training.recipe
        measured = self.evaluate is not None and (last or self.count % recipe.evaluation.every_updates == 0)
        if last or measured or self.count % recipe.updates_per_row == 0:
            self.keep_weights()
            if measured or self.count == 0:  # before the first update a tensor that fits no policy is refused
                self.make_policies()
            if measured:
                self.measure()
            self.log_row()
            self.report()

    def keep_weights(self) -> None:
        """Raises ``TrainingDiverged`` if they are not finite."""
        check_finite_model(self.model)
        self.weights = policy_weights(self.training, self.model)
        self.steps, self.updates = self.model.num_timesteps, self.count

    def make_policies(self) -> None:
        self.policies = make_policies(self.training, self.steps, self.weights)

    def measure(self) -> None:
        assert self.evaluate is not None
        begun = time.process_time()
        metrics = {name: float(value) for name, value in self.evaluate(self.policies).items()}
        spent = {"cpu_s": begun - self.cpu_start}
        self.cpu_start += time.process_time() - begun
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **spent})
        value = deciding(metrics, self.training.recipe.reward.harm_count)
        if value < self.best_value:
            self.best, self.best_value = self.policies, value
        for name, number in metrics.items():
            self.logger.record(f"eval/{name}", number)

    def log_row(self) -> None:
        self.logger.record("steps", self.model.num_timesteps, exclude="tensorboard")
        model: Any = self.model
        if self.count and hasattr(model, "dump_logs"):
            model.dump_logs(*([self.count] if isinstance(model, OnPolicyAlgorithm) else []))
        elif self.count or self.evaluations:
            self.logger.dump(step=model.num_timesteps)

    def report(self) -> None:
        if self.tell is None:
            return
        recipe = self.training.recipe
        metrics = dict(self.evaluations[-1]) if self.evaluations else {}
        rollout = self.model.n_envs * recipe.rounds
        planned = -(-recipe.total_steps // rollout) * rollout  # whole updates
        note, self.note = self.note, ""
        self.tell(
            Progress("training", self.steps, planned, metrics, note, self.updates, self.wall_s, objective="objective")
        )

    def write_checkpoint(self) -> None:
        check_finite_model(self.model)
        best = [self.best[learners[0]] for learners in self.training.groups] if self.best else []
        course = {
            "updates": self.count,
            "evaluations": self.evaluations,
            "best": [dict(policy.tensors) for policy in best],
            "best_steps": best[0].manifest.steps if best else 0,
            "best_value": self.best_value,
            "wall_s": self.wall_s,
            "cpu_s": time.process_time() - self.cpu_start,
            "progress": self.folder.progress.read_text("utf-8"),
        }
        marks = {
            "training": self.training.identity, "versions": installed_versions(), "steps": self.model.num_timesteps,
        }  # fmt: skip
        checkpoint.write(self.folder.checkpoints, {**marks, "course": course, "model": checkpoint.capture(self.model)})

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Raises ``CorruptBundle`` if the checkpoint does not fit this training."""
        course = saved["course"]
        try:
            checkpoint.restore(self.model, saved["model"])
            self.count, self.evaluations, self.best_value = (
                course["updates"], course["evaluations"], course["best_value"],
            )  # fmt: skip
            self.wall_start -= course["wall_s"]
            self.cpu_start = time.process_time() - course["cpu_s"]
            self.keep_weights()
            if course["best"]:
                tensors = [{name: tensor.numpy() for name, tensor in policy.items()} for policy in course["best"]]
                self.best = make_policies(self.training, course["best_steps"], tensors)
            self.restored = True
        except Exception as error:  # of whatever kind: Python's, NumPy's or torch's
            raise CorruptBundle(
                f"{self.folder.checkpoints}: the checkpoint of step {saved['steps']} does not fit this training:"
                f" {' '.join(str(error).split())}; delete this checkpoint to resume from an earlier one"
            ) from None

    def save(self, status: Status, reason: BaseException | None = None) -> None:
        """After an error, ``reason``, the ranges are left out: to record them, the policies must drive."""
        if self.weights:
            self.make_policies()
        if reason is None:
            self.policies, self.best = with_ranges(self.policies, self.training), with_ranges(self.best, self.training)
        for policies, place in ((self.chosen, self.folder.policy), (self.policies, self.folder.last_policy)):
            if policies:
                save_drivers(policies, place, replace=True)
        finite = [
            {name: value for name, value in evaluation.items() if math.isfinite(value)}
            for evaluation in self.evaluations
        ]
        self.folder.write_status(
            status,
            reason=None if reason is None else f"{type(reason).__name__}: {reason}",
            wall_s=round(self.wall_s, 3),
            evaluations=finite,
            steps=self.steps,
            updates=self.updates,
        )
        if status == "finished" and self.folder.checkpoints.is_dir():
            remove_folder(self.folder.checkpoints)


def check_finite_model(model: BaseAlgorithm) -> None:
    """Raise ``TrainingDiverged`` unless losses, weights and exploration noise are finite, and the noise is above 0."""
    losses = torch.tensor([value for name, value in model.logger.name_to_value.items() if name.endswith("loss")])
    noise = getattr(model.policy, "log_std", torch.zeros(1)).detach().exp()
    if not all(bool(torch.isfinite(value).all()) for value in (losses, *model.policy.parameters(), noise, 1.0 / noise)):
        raise TrainingDiverged(
            f"training: a loss, a weight or the noise of exploration is not finite at step {model.num_timesteps}; try a"
            " smaller learning_rate or max_grad_norm, or smaller weights of the reward"
        )


def policy_weights(training: Training, model: BaseAlgorithm) -> list[dict[str, Float32s]]:
    """One mapping name -> tensor for each group of learners."""
    algorithm = algorithm_of(training.recipe)
    return [algorithm.tensors(*pair) for pair in zip(algorithm.actors(model), training.networks, strict=True)]


def make_policies(training: Training, steps: int, weights: Sequence[Mapping[str, Float32s]]) -> dict[str, Policy]:
    """``weights``: for each group of learners that share a policy, name of a tensor -> its entries."""
    recipe, scenario = training.recipe, training.scenario
    policies: dict[str, Policy] = {}
    for learners, network, tensors in zip(training.groups, training.networks, weights, strict=True):
        policy = Policy.make(
            tensors,
            network=network,
            observation=training.views[training.learners.index(learners[0])],
            algorithm=recipe.algorithm,
            learners=learners,
            scenario=scenario.content(),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=steps,
        )
        policies |= dict.fromkeys(learners, policy)
    return policies
