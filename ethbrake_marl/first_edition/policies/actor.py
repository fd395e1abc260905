"""Compute a policy's actions from observations, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.policies.layers import Layers, dense, layers_of, squash
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec

BLOCK_ROWS = 256  # number of worlds computed together, so that activations fit the cache; does not change results


class Actor:
    """The deterministic policy: observations [n, F] float32 -> actions [n, A] float32 in [-1, 1].

    In a mixture of experts, only the selected expert is computed for each observation. All methods except ``__call__``
    expect transposed observations, one per column, [F, rows].
    """

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s], prefix: str = "") -> None:
        """Build the layers from the weights and biases in ``tensors``, which must fit ``spec.tensors``.

        ``prefix`` is the beginning of the tensors' names if this policy is part of another policy, for example
        ``among_1.``.
        """
        self.spec = spec
        self._networks = [layers_of(prefix + name, len(spec.policy_hidden), tensors) for name in spec.actors]
        self._gate = layers_of(f"{prefix}gate", len(spec.gate_hidden), tensors) if spec.networks > 1 else []
        self._actions = spec.actions
        self._among = [type(self)(each, tensors, f"among_{m}.") for m, each in enumerate(spec.among, 1)]

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the action for each observation, [n, A].

        Raises ``InvalidInput`` for observations with a wrong shape or dtype, or with an entry that is not finite.
        """
        seen = self._check(observation)
        action = np.empty((seen.shape[0], self.spec.action_size), dtype=np.float32)
        for start in range(0, seen.shape[0], BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            action[rows] = self._block(np.ascontiguousarray(seen[rows].T)).T
        return action

    def choose(self, x: Float32s) -> NDArray[np.int64]:
        """Return the index (from 0) of the expert that the gating network selects for each observation, [rows]."""
        chosen: NDArray[np.int64] = self._forward(self._gate, x).argmax(axis=0)
        return chosen

    def take(self, number: NDArray[np.int64], x: Float32s) -> Float32s:
        """Return for each observation the action that its entry of ``number`` [rows] selects, [1, rows].

        The lowest values of ``number`` (0, 1, ...) choose a policy in ``NetworkSpec.among``; the values after them
        choose a fixed action.
        """
        actions = self._actions[np.newaxis, np.maximum(number - len(self._among), 0)]
        for m, member in enumerate(self._among):
            rows = np.flatnonzero(number == m)
            if len(rows):
                actions[:, rows] = member._block(np.ascontiguousarray(x[:, rows]))
        return actions

    def _block(self, x: Float32s) -> Float32s:
        """Return the actions [A, rows] for the observations ``x``."""
        if len(self._networks) == 1:
            y = self._forward(self._networks[0], x)
            if self.spec.choices is not None:
                return self.take(y.argmax(axis=0), x)
        else:
            chosen = self.choose(x)
            y = np.empty((self.spec.action_size, x.shape[1]), dtype=np.float32)
            for m, layers in enumerate(self._networks):
                rows = np.flatnonzero(chosen == m)
                y[:, rows] = self._forward(layers, np.ascontiguousarray(x[:, rows]))
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        """Return the outputs [outputs, rows] of the network with these ``layers``."""
        for number, (weight, bias) in enumerate(layers, start=1):
            y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
            dense(weight, bias, x, y)
            if number == len(layers):
                break
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        return y

    def _check(self, observation: Float32s) -> Float32s:
        wanted = (observation.shape[0] if observation.ndim else 0, self.spec.observation_size)
        if observation.shape != wanted or observation.dtype != np.float32:
            raise InvalidInput(
                f"observation: has type {observation.dtype} and shape {observation.shape}; needs type float32 and shape"
                f" (n, {self.spec.observation_size}) for this policy"
            )
        if not np.isfinite(observation).all():
            row, column = np.argwhere(~np.isfinite(observation))[0]
            raise InvalidInput(f"observation[{row}, {column}] = {observation[row, column]}: must be finite")
        return observation
