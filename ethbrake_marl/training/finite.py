"""Numbers that are not finite stop a training: observations, rewards, losses, gradients and weights."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import recursive_getattr

from ethbrake_marl.errors import EthBrakeError

LOSSES = ("loss", "policy_loss", "value_loss", "policy_gradient_loss", "actor_loss", "critic_loss", "ent_coef_loss")


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """An observation, reward, loss, gradient or weight is not finite. The last policy that was finite is saved."""


def refuse_gradients(model: BaseAlgorithm) -> None:
    """Let the optimisers of a model raise ``TrainingDiverged`` before a step with a gradient that is not finite."""
    hint = "learning_rate or max_grad_norm" if hasattr(model, "max_grad_norm") else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for part in (recursive_getattr(model, name) for name in model._get_torch_save_params()[0]):
        if isinstance(part, torch.optim.Optimizer):
            part.register_step_pre_hook(check)


def check_weights(model: BaseAlgorithm) -> None:
    """Raise ``TrainingDiverged`` unless all weights are finite, and the noise of exploration finite and above 0."""
    learned = [*model.policy.parameters(), *_others(model)]
    noise = getattr(model.policy, "log_std", torch.zeros(1)).detach().exp()
    if not all(bool(torch.isfinite(each).all()) for each in [*learned, noise, 1.0 / noise]):
        raise TrainingDiverged(
            f"training: a weight or the noise of exploration is not finite at step {model.num_timesteps}; try a smaller"
            " learning_rate"
        )


def _others(model: BaseAlgorithm) -> Iterable[torch.Tensor]:
    """Return what is learned outside the policy: SAC's logarithm of the weight of entropy."""
    return (recursive_getattr(model, name).detach().exp() for name in model._get_torch_save_params()[1])


class FiniteNumbers(BaseCallback):
    """Raises ``TrainingDiverged`` at the first observation, reward or loss that is not finite."""

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
        logged = self.logger.name_to_value  # train/loss, or vehicle_2/loss of an independent learner
        for name in (name for loss in LOSSES for name in logged if name.rpartition("/")[2] == loss):
            if not np.isfinite(logged[name]):
                raise TrainingDiverged(
                    f"training: {name} = {float(logged[name])} after step {self.model.num_timesteps}: must be finite;"
                    " try a smaller learning_rate, or smaller weights of the reward"
                )
