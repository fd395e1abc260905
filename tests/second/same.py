"""Comparison of what the two editions return: the same bits, or nearly where brakes build up."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ethbrake_marl.motion.layout import BRAKE_RATE
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.fixtures.scenarios import SHIPPED

LEARNING = [name for name in SHIPPED if load_scenario(name).learners]
ALONE = [name for name in SHIPPED if len(load_scenario(name).learners) == 1]
OF_MESSAGES = ("known_from_s", "age_s", "_known_from_s", "_age_s")  # infos that an extension adds


@cache
def builds_up(name: str) -> bool:
    """Return whether brakes build up in some worlds of a scenario."""
    return bool(np.isfinite(load_scenario(name).sample(200, 1).car[:, BRAKE_RATE, 1:]).any())


def same(name: str, found: Any, expected: Any, place: str = "") -> None:
    """Fail unless ``found`` of the second edition is what the first one has, whose ``chosen_action`` is an array."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys() - set(OF_MESSAGES), place
        for key, value in found.items():
            same(name, value, expected[key], f"{place}.{key}")
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected), place
        for k, value in enumerate(found):
            same(name, value, expected[k], f"{place}[{k}]")
    elif expected is None or isinstance(expected, str | bool):
        assert found == expected, place
    else:
        one, other = np.asarray(found), np.asarray(expected)
        if "chosen_action" in place:
            np.testing.assert_allclose(one, other.reshape(one.shape), atol=1e-7, err_msg=place)
        elif one.dtype == object:
            same(name, one.tolist(), other.tolist(), place)
        elif builds_up(name) and one.dtype.kind == "f":
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9, err_msg=place)
        else:
            assert one.shape == other.shape and ((one == other) | ((one != one) & (other != other))).all(), place


def draws(rng: np.random.Generator, shape: Any, count: int | None = None) -> Any:
    """Return actions: indices below ``count``, or numbers of which half brake fully."""
    if count is not None:
        return rng.integers(count, size=shape)
    return np.where(rng.random(shape) < 0.5, -1.0, rng.uniform(-1.0, 1.0, shape))
