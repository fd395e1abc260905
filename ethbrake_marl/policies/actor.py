"""Computes a policy's actions from observations, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.layers import Float32s, Layers, dense, layers_of, squash
from ethbrake_marl.policies.network import NetworkSpec

BLOCK_ROWS = 256  # observations computed together: what lies between the layers fits the cache, with the same bits


class Actor:
    """The deterministic actions of a policy; each observation is computed independently of the others.

    ``tensors`` must fit ``spec.tensors``. ``prefix`` precedes their names if the policy is one of several in a file.
    """

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s], prefix: str = "") -> None:
        self.spec, self.actions = spec, spec.actions
        self.networks = [layers_of(tensors, prefix + name, len(spec.policy_hidden)) for name in spec.actors]
        self.gate = layers_of(tensors, f"{prefix}gate", len(spec.gate_hidden)) if spec.networks > 1 else []
        self.members = [type(self)(member, tensors, f"among_{m}.") for m, member in enumerate(spec.among, 1)]

    def __call__(self, observations: Float32s) -> Float32s:
        """Return the actions [n, 1] in [-1, 1] for observations [n, F] float32. Raises ``InvalidInput``."""
        check_observations(observations, self.spec.observation_size)
        actions = np.empty((len(observations), 1), np.float32)
        for start in range(0, len(observations), BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            actions[rows] = self.columns(np.ascontiguousarray(observations[rows].T)).T
        return actions

    def columns(self, x: Float32s) -> Float32s:
        """Return the actions [1, rows] for observations as columns, [F, rows]."""
        if not self.gate:
            y = self.forward(self.networks[0], x)
            if self.spec.output == "choice":
                return self.chosen(y.argmax(axis=0), x)
        else:
            expert = self.expert(x)
            y = np.empty((1, x.shape[1]), np.float32)
            for m, layers in enumerate(self.networks):
                rows = np.flatnonzero(expert == m)
                y[:, rows] = self.forward(layers, np.ascontiguousarray(x[:, rows]))
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def expert(self, x: Float32s) -> NDArray[np.int64]:
        """Return the number (from 0) of the expert that acts on each column of ``x`` [F, rows]."""
        return np.asarray(self.forward(self.gate, x).argmax(axis=0))

    def chosen(self, choice: NDArray[np.int64], x: Float32s) -> Float32s:
        """Return the actions [1, rows] for the highest score ``choice`` [rows] of each column of ``x`` [F, rows].

        Scores are numbered from 0: those of member policies, which then choose the action, before those of actions.
        """
        y = self.actions[np.newaxis, np.maximum(choice - len(self.members), 0)]
        for m, member in enumerate(self.members):
            rows = np.flatnonzero(choice == m)
            if len(rows):
                y[:, rows] = member.columns(np.ascontiguousarray(x[:, rows]))
        return y

    def forward(self, layers: Layers, x: Float32s) -> Float32s:
        for number, (weight, bias) in enumerate(layers, 1):
            y = np.empty((len(weight), x.shape[1]), np.float32)
            dense(weight, bias, x, y)
            if number == len(layers):
                break
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        return y


def check_observations(observations: Float32s, size: int) -> None:
    """Raise ``InvalidInput`` unless observations are finite float32 numbers, [n, size]."""
    if observations.ndim != 2 or observations.shape[1] != size or observations.dtype != np.float32:
        raise InvalidInput(
            f"observation: has type {observations.dtype} and shape {observations.shape}; needs type float32 and shape"
            f" (n, {size}) for this policy"
        )
    if not np.isfinite(observations).all():
        row, column = np.argwhere(~np.isfinite(observations))[0]
        raise InvalidInput(f"observation[{row}, {column}] = {observations[row, column]}: must be finite")
