"""Spaces of observations, actions and vector rewards; actions from callers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike

from ethbrake_marl.agents.action_scale import REACH, ActionForm, ActionScale, count_in
from ethbrake_marl.episode.features import Feature
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Floats


def feature_box(features: Sequence[Feature]) -> Box:
    """Its attribute ``features`` names its entries, and is saved with a model.

    The class is ``Box`` itself, because libraries look up the exact class of a space.
    """
    low, high = (np.array([getattr(f, end) for f in features], np.float32) for end in ("low", "high"))
    box = Box(low, high, dtype=np.float32)
    box.features = tuple(feature.name for feature in features)  # type: ignore[attr-defined]
    return box


def reward_box(components: Sequence[Any]) -> Box:
    """float64, so a weighted sum equals the scalar reward to the last bit."""
    return Box(-np.inf, np.inf, (len(components),), np.float64)


def action_space(form: ActionForm) -> Any:
    """A box [1] from -1 (full braking) to 1 (full driving), wider for an ``ActionScale``; or indices.

    The indices stand for evenly spaced actions; the space has an attribute ``evenly_spaced`` that says so, and an
    attribute ``scale`` if there is one.
    """
    count, scale = count_in(form), form if isinstance(form, ActionScale) else None
    reach = 1.0 if scale is None else REACH
    space: Any = Box(-reach, reach, (1,), np.float32) if count is None else Discrete(int(count))
    space.evenly_spaced, space.scale = count is not None, scale and tuple(scale)  # saved with a model
    return space


def checked_actions(actions: ArrayLike, shape: tuple[int, ...], whose: str, form: ActionForm = None) -> Floats:
    """Actions as a float64 array of ``shape``. The input may have more or fewer axes of length 1.

    Of ``count`` indices, k stands for ``(2 k - count + 1) / (count - 1)``, times ``REACH`` with an ``ActionScale``.
    Raises ``InvalidInput`` for a wrong shape or index, and for values that are not numbers. The range [-1, 1] is
    checked later, in ``Game.step``.
    """
    scale, count = (form, form.choices) if isinstance(form, ActionScale) else (None, form)
    try:
        numbers = np.asarray(actions)
    except ValueError:  # lists of different lengths
        numbers = np.empty(0, object)
    right, kinds = ("a number in [-1, 1]", "fiu") if count is None else (f"an index from 0 to {count - 1}", "iu")
    if numbers.dtype.kind not in kinds or (count is not None and not ((numbers >= 0) & (numbers < count)).all()):
        raise InvalidInput(f"action of {whose}: {actions!r:.60}: must be {right}")
    if count is not None:
        numbers = (2 * numbers.astype(np.int64) - (count - 1)) / (count - 1)
        numbers = numbers if scale is None else REACH * numbers
    if numbers.shape != shape:
        if [length for length in numbers.shape if length != 1] != [length for length in shape if length != 1]:
            raise InvalidInput(f"action of {whose}: has shape {numbers.shape}; must have shape {shape}")
        numbers = numbers.reshape(shape)
    return numbers.astype(np.float64) if scale is None else scale.actions(numbers.astype(np.float64))
