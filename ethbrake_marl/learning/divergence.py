"""Noticing a training that has left the numbers, before a weight is damaged."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO

from ethbrake_marl.errors import EthBrakeError

_LOSSES = ("train/loss", "train/value_loss", "train/policy_gradient_loss")


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A reward, a loss or a weight is no longer a finite number; the last good policy was kept."""


def watch_gradients(model: PPO) -> None:
    """Refuse every optimiser step whose gradients are not finite, so that the weights stay as they were."""

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps};"
                " try a smaller learning_rate or max_grad_norm"
            )

    model.policy.optimizer.register_step_pre_hook(check)


def check_update(model: PPO) -> None:
    """Refuse an update whose losses or weights are not finite; an infinite loss may well leave finite weights."""
    logged = model.logger.name_to_value
    losses = {name: float(logged[name]) for name in _LOSSES if name in logged}
    for name, value in losses.items():
        if not np.isfinite(value):
            raise TrainingDiverged(
                f"training: {name} = {value} after step {model.num_timesteps}: must be finite;"
                " try a smaller learning_rate, or smaller weights of the reward"
            )
    if not weights_are_finite(model):
        raise TrainingDiverged(f"training: a weight is not finite after step {model.num_timesteps}")


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


def weights_are_finite(model: PPO) -> bool:
    """Whether every weight is finite, and the exploration noise a usable one."""
    finite = all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())
    spread = torch.exp(model.policy.log_std.detach())
    return finite and bool(torch.isfinite(spread).all()) and bool((spread > 0.0).all())
