"""Noticing a training that has left the numbers, before a weight is damaged."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO

from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.learning.model_state import Model, optimizers_of

_LOSSES = (
    "loss",
    "value_loss",
    "policy_gradient_loss",
    "actor_loss",
    "critic_loss",
    "ent_coef_loss",
)


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A reward, a loss or a weight is no longer a finite number; the last good policy was kept."""


def watch_gradients(model: Model) -> None:
    """Refuse every optimiser step whose gradients are not finite, so that the weights stay as they were."""
    hint = "learning_rate or max_grad_norm" if isinstance(model, PPO) else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for optimizer in optimizers_of(model).values():
        optimizer.register_step_pre_hook(check)


def check_losses(model: Model) -> None:
    """Refuse an update whose losses are not finite; an infinite loss may well leave finite weights."""
    logged = model.logger.name_to_value  # train/loss, or vehicle_2/loss where learners are independent
    found = ((name, float(logged[name])) for loss in _LOSSES for name in logged if name.rpartition("/")[2] == loss)
    for name, value in found:
        if not np.isfinite(value):
            raise TrainingDiverged(
                f"training: {name} = {value} after step {model.num_timesteps}: must be finite;"
                " try a smaller learning_rate, or smaller weights of the reward"
            )


def check_weights(model: Model) -> None:
    """Refuse weights that are not finite."""
    if not weights_are_finite(model):
        raise TrainingDiverged(f"training: a weight is not finite after step {model.num_timesteps}")


def check_step(model: Model, rewards: Any, observations: Any) -> None:
    """Refuse a step with a reward or observation that is not finite; names which."""
    for name, entries in (("observations", observations), ("rewards", rewards)):
        good = np.isfinite(entries)
        if not good.all():
            row = np.argwhere(~good)[0][0]
            raise TrainingDiverged(
                f"training: {name}[row {row}] = {entries[~good][0]} at step {model.num_timesteps}: must be finite;"
                " the environment or its reward is at fault"
            )


def check_rollout(model: PPO) -> None:
    """Refuse a rollout that holds a reward or observation that is not finite; names which."""
    for name in ("observations", "rewards"):
        entries = getattr(model.rollout_buffer, name)
        good = np.isfinite(entries)
        if not good.all():
            step, row = np.argwhere(~good)[0][:2]
            raise TrainingDiverged(
                f"training: {name}[step {step}, row {row}] = {entries[~good][0]} in the rollout that ends at step"
                f" {model.num_timesteps}: must be finite; the environment or its reward is at fault"
            )


def weights_are_finite(model: Model) -> bool:
    """Whether every weight is finite, and the exploration noise a usable one."""
    numbers = [*model.policy.parameters()]
    spread = None
    if isinstance(model, PPO):
        spread = torch.exp(model.policy.log_std.detach())
    elif model.log_ent_coef is not None:
        spread = torch.exp(model.log_ent_coef.detach())
    finite = all(bool(torch.isfinite(p).all()) for p in numbers)
    return finite and (spread is None or bool((torch.isfinite(spread) & (spread > 0.0)).all()))
