"""The optimiser Adam, one gradient step, and a running average of weights."""

from __future__ import annotations

import inspect
from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.optim import Optimizer


class Adam(torch.optim.Adam):
    """Torch's optimiser Adam without the decorators of its methods; the results are the same, bit for bit.

    The decorators would import torch's compiler, which takes 1 to 3 s of processor time.
    """


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


def adam(rate: float, *networks: nn.Module | None) -> Adam:
    """Return an Adam optimiser for all weights of ``networks``; None is skipped."""
    return Adam([weight for each in networks if each is not None for weight in each.parameters()], lr=rate, eps=1e-5)


def descend(optimizer: Optimizer, *losses: Tensor) -> None:
    """Make one gradient step of ``optimizer`` on the sum of ``losses`` (scalars)."""
    optimizer.zero_grad()
    for loss in losses:
        loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@torch.no_grad()
def follow(average: Iterable[Tensor], learning: nn.Module, keep: float) -> None:
    """Update averaged weights in place: ``average = keep * average + (1 - keep) * learning``.

    ``average`` has the order of ``learning.parameters()``.
    """
    for mean, learns in zip(average, learning.parameters(), strict=True):
        mean.lerp_(learns, 1.0 - keep)
