"""Targets for the actor, computed from measured gradients, at most one trust radius away from its outputs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.policies.network_spec import Float32s


class Tried(NamedTuple):
    """B decisions at which a higher and a lower action were tried, and the gradients measured from the two returns."""

    seen: Float32s  # [B, F] observations
    mean: Float32s  # [B] output of the actor, before clipping to [-1, 1]
    gradient: Float32s  # [B] gradient of the return with respect to the action
    importance: Float32s  # [B] weight of each decision in the loss


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Return targets [B] for the actor's outputs, and the weights [B] of their squared errors in the loss.

    For an output ``m`` with the gradient ``g``: ``weight = (|g| / radius) + anchor`` and ``target = m + (g / weight)``.
    The target is less than ``radius`` away from ``m`` for every gradient. At ``m``, the loss
    ``(weight / 2) * (output - target)^2`` has the slope ``-g``, as gradient ascent on the return requires.

    If an output is already at or beyond a bound of [-1, 1], it gets no target farther out, because clipping would leave
    the action unchanged.

    Args:
        tried: decisions and measured gradients.
        radius: trust radius: limit of the distance from an output to its target.
        anchor: least weight, above 0. A larger anchor brings the target closer to the output, most of all for a small
            gradient.

    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
