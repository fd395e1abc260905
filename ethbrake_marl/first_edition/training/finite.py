"""Checks that stop a training run if an observation, a reward, a loss, a gradient or a weight is not finite."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.first_edition.training.algorithm import Algorithm

LOSSES = ("loss", "policy_loss", "value_loss", "policy_gradient_loss", "actor_loss", "critic_loss", "ent_coef_loss")


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """Raised if an observation, reward, loss, gradient or weight is not finite; the last finite policy is saved."""


def refuse_gradients(model: BaseAlgorithm, algorithm: Algorithm) -> None:
    """Make every optimiser of the model raise ``TrainingDiverged`` before a step with a gradient that is not finite."""
    hint = "learning_rate or max_grad_norm" if hasattr(model, "max_grad_norm") else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for optimizer in algorithm.optimizers(model).values():
        optimizer.register_step_pre_hook(check)


def weights_are_finite(model: BaseAlgorithm, algorithm: Algorithm) -> bool:
    """Return True if all weights of the model are finite and its exploration noise is finite and above 0."""
    logarithm = algorithm.log_noise(model)
    noise = torch.ones(1) if logarithm is None else torch.exp(logarithm)
    usable = torch.isfinite(noise) & (noise > 0.0)
    return bool(usable.all()) and all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())


class FiniteNumbers(BaseCallback):
    """Callback that raises ``TrainingDiverged`` at the first observation, reward or loss that is not finite."""

    def _on_step(self) -> bool:
        for name, entries in (("observations", self.locals["new_obs"]), ("rewards", self.locals["rewards"])):
            good = np.isfinite(entries)
            if not good.all():
                row = np.argwhere(~good)[0][0]
                raise TrainingDiverged(
                    f"training: {name}[row {row}] = {entries[~good][0]} at step {self.model.num_timesteps}: must be"
                    " finite; correct the observations or the reward of the environment"
                )
        return True

    def _on_rollout_start(self) -> None:
        self._check_losses()

    def _on_training_end(self) -> None:
        self._check_losses()

    def _check_losses(self) -> None:
        logged = self.logger.name_to_value  # names such as train/loss, or vehicle_2/loss for independent learners
        for name in (name for loss in LOSSES for name in logged if name.rpartition("/")[2] == loss):
            if not np.isfinite(logged[name]):
                raise TrainingDiverged(
                    f"training: {name} = {float(logged[name])} after step {self.model.num_timesteps}: must be finite;"
                    " try a smaller learning_rate, or smaller weights of the reward"
                )
