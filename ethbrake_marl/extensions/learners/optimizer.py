"""Adam, one gradient step, and a running average of weights."""

from __future__ import annotations

import inspect
from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.optim import Optimizer


class Adam(torch.optim.Adam):
    """Adam optimiser of torch with the same results, bit for bit, that does not import torch's compiler.

    Its methods lack torch's decorators, which would import the compiler (1 to 3 s of CPU).
    """


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


def adam(rate: float, *networks: nn.Module | None) -> Adam:
    """Return an Adam optimiser with the learning rate ``rate`` for all weights of these networks; None is skipped."""
    return Adam([weight for each in networks if each is not None for weight in each.parameters()], lr=rate, eps=1e-5)


def descend(optimizer: Optimizer, *losses: Tensor) -> None:
    """Change the weights of ``optimizer`` by one gradient step that lowers the sum of these losses (scalars)."""
    optimizer.zero_grad()
    for loss in losses:
        loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@torch.no_grad()
def follow(average: Iterable[Tensor], learning: nn.Module, keep: float) -> None:
    """Move averaged weights towards the weights of ``learning``: ``average = keep average + (1 - keep) learning``.

    ``average`` holds the averaged weights in the order of ``learning.parameters()``; they are changed.
    """
    for mean, learns in zip(average, learning.parameters(), strict=True):
        mean.lerp_(learns, 1.0 - keep)
