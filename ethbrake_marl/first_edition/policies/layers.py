"""Layers of a network: matrix product and hyperbolic tangent with the same bits in any batch, on any machine.

Mathematics libraries round ``tanh`` and sums differently on different machines, and even at different positions in an
array. This module computes ``tanh`` and sums by fixed sequences of IEEE operations.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.first_edition.physics.elementary import PER_LN2, exp_rest
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.policies.network_spec import Float32s

_SATURATED = 10.0  # above 9.02 tanh is 1 in single precision

_SMALL = 1e-4  # below this, x - x^3 / 3 is tanh(x) to double precision


@compiled
def squash(values: NDArray[np.float32]) -> None:
    """Replace every entry of ``values`` [k, rows] by its hyperbolic tangent, in place.

    The rounding error is little more than half a unit in the last place of a float32.
    """
    for j in range(values.shape[0]):
        row = values[j]
        for r in range(row.shape[0]):
            x = float(row[r])
            a = min(abs(x), _SATURATED)
            z = 2.0 * a
            k = int(z * PER_LN2 + 0.5)
            t = 1.0 - 2.0 / (exp_rest(z, k) * float(1 << k) + 1.0)
            if a < _SMALL:
                t = a - a * a * a / 3.0
            row[r] = np.float32(t if x >= 0.0 else -t)


Layers = list[tuple[Float32s, Float32s]]  # weights and biases, from the first layer to the last


def layers_of(name: str, hidden: int, tensors: Mapping[str, Float32s]) -> Layers:
    names = [f"{name}.{k}" for k in range(hidden)] + [f"{name}.output"]
    return [
        (np.ascontiguousarray(tensors[f"{layer}.weight"]), np.ascontiguousarray(tensors[f"{layer}.bias"]))
        for layer in names
    ]


@compiled
def dense(weight: Float32s, bias: Float32s, x: Float32s, y: Float32s) -> None:
    """Compute one layer of a network, ``y = weight x + bias``, into ``y`` [O, rows].

    ``weight`` is [O, K], ``bias`` [O], and ``x`` [K, rows] has one column per observation. The products of weights and
    inputs are added in groups of four, ``(a + b) + (c + d)``, always in this order, without fused or reordered
    operations (no fastmath). The rounding error is half as large as in a sum that adds one product after another. The
    result for a column of ``x`` does not depend on the other columns.
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
