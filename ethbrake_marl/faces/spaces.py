"""Spaces of observations and vector rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from ethbrake_marl.episode.features import Feature


def feature_box(features: Sequence[Feature]) -> Box:
    """Return a float32 box with the names of its entries in ``features``, which is saved with a model.

    The box is a plain one, because libraries look up the exact class of a space.
    """
    low, high = (np.array([getattr(f, end) for f in features], np.float32) for end in ("low", "high"))
    box = Box(low, high, dtype=np.float32)
    box.features = tuple(feature.name for feature in features)  # type: ignore[attr-defined]
    return box


def reward_box(components: Sequence[Any]) -> Box:
    """Return the space of vector rewards: float64, so a weighted sum equals the scalar reward to the last bit."""
    return Box(-np.inf, np.inf, (len(components),), np.float64)


FeatureBox = Box  # the name of the class in models that were saved by 1.0.0
