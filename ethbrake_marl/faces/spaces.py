"""Spaces of observations and vector rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from ethbrake_marl.episode.features import Feature


class FeatureBox(Box):
    """A float32 box whose entries have names (``features``), which are saved with a model."""

    def __init__(self, features: Sequence[Feature]) -> None:
        self.features = tuple(feature.name for feature in features)
        low, high = (np.array([getattr(f, end) for f in features], np.float32) for end in ("low", "high"))
        super().__init__(low, high, dtype=np.float32)


def reward_box(components: Sequence[Any]) -> Box:
    """Return the space of vector rewards: float64, so a weighted sum equals the scalar reward to the last bit."""
    return Box(-np.inf, np.inf, (len(components),), np.float64)
