"""The hyperbolic tangent from products, sums and one quotient: the same bits in any batch and on any machine.

Vector units and mathematics libraries round their own ``tanh`` differently, by machine and even by where in an array a
number stands. Here it is a fixed sequence of IEEE operations in double precision, rounded to single at the end.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.elementary import LN2_HIGH, LN2_LOW, PER_LN2, exp_of_small
from ethbrake_marl.policies.manifest import NetworkSpec, actor_names

_SATURATED = 10.0  # from 9.02 on the single-precision result is 1
_SMALL = 1e-4  # below, x - x^3 / 3 is exact to double precision


@compiled
def squash(values: NDArray[np.float32]) -> None:
    """Replace ``values`` [k, rows] by their hyperbolic tangents, within half a unit of the last place (and a hair)."""
    for j in range(values.shape[0]):
        row = values[j]
        for r in range(row.shape[0]):
            x = float(row[r])
            a = min(abs(x), _SATURATED)
            z = 2.0 * a
            k = int(z * PER_LN2 + 0.5)
            s = (z - k * LN2_HIGH) - k * LN2_LOW  # |s| <= ln(2) / 2
            e = exp_of_small(s)
            t = 1.0 - 2.0 / (e * float(1 << k) + 1.0)
            if a < _SMALL:
                t = a - a * a * a / 3.0
            row[r] = np.float32(t if x >= 0.0 else -t)


Float32s = NDArray[np.float32]

Layers = list[tuple[Float32s, Float32s]]  # weights and biases, from the first layer to the last

BLOCK_ROWS = 256  # worlds handled together: their activations stay in the cache; changes no bit of any of them


class Actor:
    """The deterministic policy: observation [n, F] float32 -> action [n, A] float32 in [-1, 1].

    Of several networks only the one that the gate chooses is computed in a row.
    """

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s]) -> None:
        """Take the layers out of ``tensors``, which must fit ``spec`` (see ``tensor_table``)."""
        self.spec = spec
        self._networks = [_layers_of(name, len(spec.policy_hidden), tensors) for name in actor_names(spec)]
        self._gate = _layers_of("gate", len(spec.gate_hidden), tensors) if spec.networks > 1 else []

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the action of each row; raises ``InvalidInput`` on a wrong shape, dtype or a non-finite entry."""
        seen = self._check(observation)
        action = np.empty((seen.shape[0], self.spec.action_size), dtype=np.float32)
        for start in range(0, seen.shape[0], BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            action[rows] = self._block(np.ascontiguousarray(seen[rows].T)).T
        return action

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Which of its networks acts in each row, [n] from 0; raises what a call raises."""
        return self._choose(np.ascontiguousarray(self._check(observation).T))

    def _choose(self, x: Float32s) -> NDArray[np.int64]:
        """[F, rows] -> [rows]."""
        if not self._gate:
            return np.zeros(x.shape[1], np.int64)
        chosen: NDArray[np.int64] = self._forward(self._gate, x).argmax(axis=0)
        return chosen

    def _block(self, x: Float32s) -> Float32s:
        """[F, rows] -> [A, rows]."""
        if len(self._networks) == 1:
            y = self._forward(self._networks[0], x)
        else:
            chosen = self._choose(x)
            y = np.empty((self.spec.action_size, x.shape[1]), dtype=np.float32)
            for m, layers in enumerate(self._networks):
                rows = np.flatnonzero(chosen == m)
                y[:, rows] = self._forward(layers, np.ascontiguousarray(x[:, rows]))
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        """[F, rows] -> [outputs, rows] of one network."""
        for weight, bias in layers[:-1]:
            y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
            dense(weight, bias, x, y)
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        weight, bias = layers[-1]
        y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
        dense(weight, bias, x, y)
        return y

    def _check(self, observation: Float32s) -> Float32s:
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


def _layers_of(name: str, hidden: int, tensors: Mapping[str, Float32s]) -> Layers:
    names = [f"{name}.{k}" for k in range(hidden)] + [f"{name}.output"]
    return [
        (np.ascontiguousarray(tensors[f"{layer}.weight"]), np.ascontiguousarray(tensors[f"{layer}.bias"]))
        for layer in names
    ]


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
