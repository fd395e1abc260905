"""Layers of a network whose results have the same bits in any batch, on any machine.

Libraries round ``tanh`` and sums differently on different machines, and even at different positions of an array. Here
both are fixed sequences of IEEE operations.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.elementary import PER_LN2, exp_rest

Float32s = NDArray[np.float32]
Layers = list[tuple[Float32s, Float32s]]  # weights and biases, from the first layer to the last

SATURATED = 10.0  # above 9.02 tanh is 1 in single precision
CUBIC_BELOW = 1e-4  # below this, x - x^3 / 3 is tanh(x) to double precision


def layers_of(tensors: Mapping[str, Float32s], name: str, hidden: int) -> Layers:
    """Weight and bias of each layer, the output layer last."""
    names = [f"{name}.{k}" for k in range(hidden)] + [f"{name}.output"]
    return [
        (np.ascontiguousarray(tensors[f"{layer}.weight"]), np.ascontiguousarray(tensors[f"{layer}.bias"]))
        for layer in names
    ]


@large
def dense(weight: Float32s, bias: Float32s, x: Float32s, y: Float32s) -> None:
    """Write ``weight x + bias`` to ``y`` [O, rows]; ``weight`` is [O, K], ``x`` [K, rows], one column per observation.

    Products are added in groups of four, ``(a + b) + (c + d)``, always in this order, which halves the rounding error
    of a plain sum. A column of ``y`` depends only on the same column of ``x``.
    """
    inputs = weight.shape[1]
    block_end = inputs - inputs % 4
    for j in range(weight.shape[0]):
        out = y[j]
        out[:] = bias[j]
        for k in range(0, block_end, 4):
            w0, w1, w2, w3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for r in range(out.shape[0]):
                out[r] += (w0 * x0[r] + w1 * x1[r]) + (w2 * x2[r] + w3 * x3[r])
        for k in range(block_end, inputs):
            for r in range(out.shape[0]):
                out[r] += weight[j, k] * x[k, r]


@large
def squash(values: Float32s) -> None:
    """Replace ``values`` [outputs, rows] by their tanh, with an error of about half a unit in the last place.

    ``tanh(a) = 1 - 2 / (e^(2 a) + 1)``
    """
    for j in range(values.shape[0]):
        row = values[j]
        for r in range(row.shape[0]):
            x = float(row[r])
            a = min(abs(x), SATURATED)
            z = 2.0 * a
            k = int(z * PER_LN2 + 0.5)
            t = 1.0 - 2.0 / (exp_rest(z, k) * float(1 << k) + 1.0)
            if a < CUBIC_BELOW:
                t = a - a * a * a / 3.0
            row[r] = np.float32(t if x >= 0.0 else -t)
