"""Turn a measured gradient into a target for the actor that is at most one trust radius away."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.policies.network_spec import Float32s


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and what that brought."""

    seen: Float32s  # [B, F]
    mean: Float32s  # [B] what the actor said; beyond -1 and 1 it means -1 and 1
    gradient: Float32s  # [B] of the return by the action
    importance: Float32s  # [B] what each counts


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Where the means [B] should go, and how much that weighs [B]: ``m + g / w`` with ``w = |g| / radius + anchor``.

    Half the weighted squared distance from there is, up to a constant, ``-g (mu - m) + w (mu - m)^2 / 2``: the exact
    slope, and a curvature with which nothing moves farther than the radius, however large its gradient. A mean at or
    beyond a bound is not asked to go farther out, where its action would not change.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
