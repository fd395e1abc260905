"""Computes a policy's actions from observations, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.layers import Float32s, dense, layers_of, squash
from ethbrake_marl.policies.network import NetworkSpec

BLOCK_ROWS = 256  # observations computed together: outputs of a layer then fit the cache; the bits are the same


class Actor:
    """Computes the deterministic actions of a policy, each observation independently of the others."""

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s]) -> None:
        self.spec = spec
        self.layers = layers_of(tensors, "policy", len(spec.policy_hidden))

    def __call__(self, observations: Float32s) -> Float32s:
        """Actions [n, 1] in [-1, 1] for observations [n, F] float32.

        Raises ``InvalidInput`` for a wrong shape or type, and for observations that are not finite.
        """
        check_observations(observations, self.spec.observation_size)
        actions = np.empty((len(observations), 1), np.float32)
        for start in range(0, len(observations), BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            actions[rows] = self.columns(np.ascontiguousarray(observations[rows].T)).T
        return actions

    def columns(self, x: Float32s) -> Float32s:
        """Actions [1, rows] for observations that are stored as columns, [F, rows]."""
        y = self.forward(x)
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def forward(self, x: Float32s) -> Float32s:
        """Outputs of the last layer, [1, rows], for observations as columns, [F, rows]."""
        for number, (weight, bias) in enumerate(self.layers, 1):
            y = np.empty((len(weight), x.shape[1]), np.float32)
            dense(weight, bias, x, y)
            if number == len(self.layers):
                break
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        return y


def check_observations(observations: Float32s, size: int) -> None:
    if observations.ndim != 2 or observations.shape[1] != size or observations.dtype != np.float32:
        raise InvalidInput(
            f"observation: has type {observations.dtype} and shape {observations.shape}; needs type float32 and shape"
            f" (n, {size}) for this policy"
        )
    if not np.isfinite(observations).all():
        row, column = np.argwhere(~np.isfinite(observations))[0]
        raise InvalidInput(f"observation[{row}, {column}] = {observations[row, column]}: must be finite")
