"""Turn a measured gradient into a target for the actor that is at most one trust radius away."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.policies.network_spec import Float32s


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and the measured gradients."""

    seen: Float32s  # [B, F] observations
    mean: Float32s  # [B] output of the actor, before clipping to [-1, 1]
    gradient: Float32s  # [B] gradient of the return with respect to the action
    importance: Float32s  # [B] weight of each decision


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Return targets [B] for the actor's means, and their weights [B].

    ``target = m + g / w`` with ``w = |g| / radius + anchor``, for mean m and gradient g. Half the weighted squared
    distance to the target is ``-g (mu - m) + w (mu - m)^2 / 2`` up to a constant. Its slope at ``m`` is exact, and its
    minimum is at most one radius away, however large the gradient. A mean at or beyond a bound is not moved farther
    out, because its action would not change.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
