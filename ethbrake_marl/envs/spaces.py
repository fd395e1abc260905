"""Spaces of observations, states and actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box

from ethbrake_marl.observations import Feature


def feature_box(features: Sequence[Feature]) -> Box[np.float32]:
    """Float32 box [F] with the features' bounds, which are finite."""
    low, high = (np.array([getattr(f, side) for f in features], np.float32) for side in ("low", "high"))
    return Box(low, high, dtype=np.float32)


def action_box() -> Box[np.float32]:
    """Float32 box [1]: -1 full braking capacity, 0 coasts, +1 full driving capacity."""
    return Box(-1.0, 1.0, (1,), dtype=np.float32)
