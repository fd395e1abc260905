"""The networks of a policy: their sizes, and the names and shapes of their tensors."""

from __future__ import annotations

from operator import not_
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
      score is taken, the lowest one in a tie. Before these may come scores of other policies (``among``) on the same
      observation; if one of them is the highest, this policy chooses the action. No noise, no critic.

    With ``networks`` above 1 the policy is a mixture of experts: several actors of the same shape, and a gating network
    (hidden layers ``gate_hidden``) that scores them at every decision. The actor with the highest score acts, the first
    one in a tie. No noise, no critic.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]  # F
    action_size: Literal[1] = 1
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]  # width of each hidden layer of an actor
    value_hidden: PerhapsHidden  # of the critic; empty: no critic, which no policy needs to act
    activation: Activation
    output: Literal["clip", "tanh", "choice"]
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()
    among: Annotated[tuple[NetworkSpec, ...], Field(max_length=16, exclude_if=not_)] = ()

    @model_validator(mode="after")
    def _settings_fit(self) -> NetworkSpec:
        mixture, choice = self.networks > 1, self.output == "choice"
        if mixture != bool(self.gate_hidden):
            raise ValueError(
                f"gate_hidden = {list(self.gate_hidden)}: must have a layer if networks is above 1, and must be left"
                f" out if networks is 1; networks is {self.networks}"
            )
        if choice != (self.choices is not None):
            raise ValueError(
                f"choices = {self.choices}: must be a number if output is 'choice', and must be left out otherwise;"
                f" output is {self.output!r}"
            )
        if (mixture or choice) and self.value_hidden:
            raise ValueError("value_hidden: must be empty if networks is above 1 or output is 'choice'")
        if choice and mixture:
            raise ValueError("output = 'choice': needs networks = 1")
        for m, member in enumerate(self.among):
            if not choice or member.among or member.observation_size != self.observation_size:
                raise ValueError(
                    f"among[{m}]: needs output = 'choice', no key among of its own, and"
                    f" observation_size = {self.observation_size}"
                )
        return self

    @property
    def actors(self) -> tuple[str, ...]:
        """Prefixes of the names of the actors' tensors."""
        return ("policy",) if self.networks == 1 else tuple(f"network_{m + 1}" for m in range(self.networks))

    @property
    def actions(self) -> Float32s:
        """Actions whose scores are the outputs under ``choice``, [choices]."""
        return np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)

    @property
    def format_version(self) -> Literal[2, 3, 4, 5]:
        """Lowest version of the file format that supports this network."""
        if self.choices is not None:
            return 5 if self.among else 4
        return 2 if self.networks == 1 else 3

    @property
    def tensors(self) -> Shapes:
        """Name -> shape of every float32 tensor; a weight is [outputs, inputs], as in ``y = W x + b``."""
        outputs = 1 if self.choices is None else len(self.among) + self.choices
        shapes: Shapes = {}
        for name in self.actors:
            shapes |= self._network(name, self.policy_hidden, outputs)
        if self.networks > 1:
            shapes |= self._network("gate", self.gate_hidden, self.networks)
        elif self.choices is not None:
            for m, member in enumerate(self.among, 1):
                shapes |= {f"among_{m}.{name}": shape for name, shape in member.tensors.items()}
        elif self.output == "clip":
            shapes["policy.log_std"] = (1,)
        else:
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
