"""Targets for the actor's outputs, computed from measured gradients.

A target is at most one trust radius away from the output.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.policies.network_spec import Float32s


class Tried(NamedTuple):
    """B decisions at which a higher and a lower action were tried, with the gradients measured from the two returns."""

    seen: Float32s  # [B, F] observations
    mean: Float32s  # [B] output of the actor, before clipping to [-1, 1]
    gradient: Float32s  # [B] gradient of the return with respect to the action
    importance: Float32s  # [B] weight of each decision in the loss


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Return targets [B] for the actor's outputs at B decisions, and the weights [B] of the squared errors in the loss.

    For an output ``m`` at which the return has the measured gradient ``g``: ``weight = (|g| / radius) + anchor`` and
    ``target = m + (g / weight)``. The target is less than ``radius`` away from ``m`` for every gradient. At ``output =
    m``, the loss ``(weight / 2) * (output - target)^2`` has the slope ``-g``. So a step that lowers the loss raises the
    return.

    If an output is already at or beyond -1 or 1, the target is not farther out than the output, because actions are
    clipped to [-1, 1].

    Args:
        tried: decisions and measured gradients.
        radius: trust radius, which no distance from an output to its target reaches.
        anchor: weight of a decision with the gradient 0, above 0. A larger ``anchor`` brings the target closer to the
            output, especially if the gradient is small.

    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
