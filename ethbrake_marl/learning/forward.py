"""The actor's forward pass without torch: the same bits for a world alone, in any batch, on any machine.

A matrix product from BLAS rounds a row differently depending on how many rows stand beside it and where in the
block it stands (measured, even in zero-padded blocks of fixed size). Here every output is one fixed sequence of
float32 products and sums, vectorised across worlds, so that neither can matter.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.networks import NetworkSpec
from ethbrake_marl.learning.squash import squash
from ethbrake_marl.physics.compiled import compiled

Float32s = NDArray[np.float32]

BLOCK_ROWS = 64  # worlds handled together: their activations stay in the first cache


class Actor:
    """The deterministic policy: observation [n, F] float32 -> action [n, A] float32 in [-1, 1]."""

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s]) -> None:
        """Take the actor's layers out of ``tensors``, which must fit ``spec`` (see ``tensor_table``)."""
        self.spec = spec
        names = [f"policy.{k}" for k in range(len(spec.policy_hidden))] + ["policy.output"]
        self._layers = [
            (np.ascontiguousarray(tensors[f"{name}.weight"]), np.ascontiguousarray(tensors[f"{name}.bias"]))
            for name in names
        ]

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the action of each row; raises ``InvalidInput`` on a wrong shape, dtype or a non-finite entry."""
        seen = self._checked(observation)
        action = np.empty((seen.shape[0], self.spec.action_size), dtype=np.float32)
        for start in range(0, seen.shape[0], BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            action[rows] = self._block(np.ascontiguousarray(seen[rows].T)).T
        return action

    def _block(self, x: Float32s) -> Float32s:
        """[F, rows] -> [A, rows]."""
        for k, (weight, bias) in enumerate(self._layers):
            y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
            dense(weight, bias, x, y)
            if k == len(self._layers) - 1:
                break
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def _checked(self, observation: Float32s) -> Float32s:
        wanted = (observation.shape[0] if observation.ndim else 0, self.spec.observation_size)
        if observation.shape != wanted or observation.dtype != np.float32:
            raise InvalidInput(
                f"observation: {observation.dtype} of shape {observation.shape};"
                f" this policy takes float32 [n, {self.spec.observation_size}]"
            )
        if not np.isfinite(observation).all():
            row, column = np.argwhere(~np.isfinite(observation))[0]
            raise InvalidInput(f"observation[{row}, {column}] = {observation[row, column]}: must be finite")
        return observation


@compiled
def dense(weight: Float32s, bias: Float32s, x: Float32s, y: Float32s) -> None:
    """Fill ``y = weight x + bias`` for weight [O, K], bias [O], x [K, rows], y [O, rows]; rows are independent.

    Inputs are added in groups of four, ``(a + b) + (c + d)``, always in this order and never fused or reordered
    (no fastmath): half the rounding of a plain running sum, and the same result whatever the other rows hold.
    """
    inputs = weight.shape[1]
    whole = inputs - inputs % 4
    for j in range(weight.shape[0]):
        out = y[j]
        out[:] = bias[j]
        for k in range(0, whole, 4):
            w0, w1, w2, w3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for r in range(out.shape[0]):
                out[r] += (w0 * x0[r] + w1 * x1[r]) + (w2 * x2[r] + w3 * x3[r])
        for k in range(whole, inputs):
            for r in range(out.shape[0]):
                out[r] += weight[j, k] * x[k, r]
