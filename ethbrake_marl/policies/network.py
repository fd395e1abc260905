"""The networks of a policy: their sizes, and the names and shapes of their tensors."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.policies.layers import Float32s

Activation = Literal["relu", "tanh"]
Width = Annotated[int, Field(ge=1, le=4096)]
PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]
Shapes = dict[str, tuple[int, ...]]


class NetworkSpec(FileModel):
    """An actor and optionally a critic: multilayer perceptrons with the same input.

    ``output`` says how the actor's outputs give an action in [-1, 1]:

    - ``clip``: the output, clipped. In training (PPO) it is the mean of a Gaussian with one noise parameter per action.
    - ``tanh``: the tanh of the output. In training (SAC) a second head of the actor gives the noise.
    - ``choice``: the outputs are scores of ``choices`` actions, evenly spaced from -1 to 1. The action with the highest
      score is taken; in a tie, the lowest action. There is no noise and no critic.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]  # F
    action_size: Literal[1] = 1
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]  # width of each hidden layer of the actor
    value_hidden: PerhapsHidden  # of the critic; empty: no critic, which no policy needs to act
    activation: Activation
    output: Literal["clip", "tanh", "choice"]
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None

    @model_validator(mode="after")
    def _settings_fit(self) -> NetworkSpec:
        choice = self.output == "choice"
        if choice != (self.choices is not None):
            raise ValueError(
                f"choices = {self.choices}: must be a number if output is 'choice', and must be left out otherwise;"
                f" output is {self.output!r}"
            )
        if choice and self.value_hidden:
            raise ValueError("value_hidden: must be empty if output is 'choice'")
        return self

    @property
    def actions(self) -> Float32s:
        """Actions that the outputs score, if ``output`` is ``choice``, [choices]."""
        return np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)

    @property
    def format_version(self) -> Literal[2, 4]:
        """Lowest version of the file format that supports this network."""
        return 2 if self.choices is None else 4

    @property
    def tensors(self) -> Shapes:
        """Shapes of all float32 tensors, name -> shape; a weight is [outputs, inputs], as in ``y = W x + b``."""
        shapes = self._network("policy", self.policy_hidden, self.choices or 1)
        if self.output == "clip":
            shapes["policy.log_std"] = (1,)
        elif self.output == "tanh":
            shapes |= _layer("policy.log_std", self.policy_hidden[-1], 1)
        if self.value_hidden:
            shapes |= self._network("value", self.value_hidden, 1)
        return shapes

    def _network(self, name: str, hidden: tuple[int, ...], outputs: int) -> Shapes:
        sizes = (self.observation_size, *hidden)
        shapes: Shapes = {}
        for k, width in enumerate(hidden):
            shapes |= _layer(f"{name}.{k}", sizes[k], width)
        return shapes | _layer(f"{name}.output", sizes[-1], outputs)


def _layer(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
