"""Targets towards which the actor's outputs are trained, computed from measured gradients of the return.

The distance from an output of the actor to its target is always less than a fixed length, the trust radius.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.policies.network_spec import Float32s


class Tried(NamedTuple):
    """B decisions at which a higher and a lower action were tried, with the gradients measured from the two returns."""

    seen: Float32s  # [B, F] observations
    mean: Float32s  # [B] output of the actor, before clipping to [-1, 1]
    gradient: Float32s  # [B] gradient of the return with respect to the action
    importance: Float32s  # [B] weight of each decision in the loss


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Return targets [B] for the actor's outputs at B decisions, and the weights [B] of the squared errors in the loss.

    Let ``m`` be the actor's present output at a decision, and ``g`` the measured gradient of the return. Then ``weight
    = (|g| / radius) + anchor`` and ``target = m + (g / weight)``. The distance between the target and ``m`` is always
    less than ``radius``. ``anchor`` must be above 0; it is the weight of a decision with gradient 0, and a larger
    ``anchor`` moves the target closer to ``m``, especially if the gradient is small. At ``output = m``, the loss
    ``(weight / 2) * (output - target)^2`` has the slope ``-g``; therefore a small change of the output that lowers the
    loss raises the return.

    Because actions are clipped to [-1, 1], the target of an output at or above 1 is never above the output, and the
    target of an output at or below -1 is never below the output.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
