"""The networks of a policy: their sizes, and the table of their tensors."""

from __future__ import annotations

from itertools import chain
from operator import not_
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ethbrake_marl.files.model import FileModel

Activation = Literal["relu", "tanh"]

Width = Annotated[int, Field(ge=1, le=4096)]

PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]


class TensorRow(NamedTuple):
    """Name and shape of a tensor in a bundle."""

    name: str  # such as ``policy.0.weight``
    shape: tuple[int, ...]  # length of each axis

    def inside(self, part: str) -> TensorRow:
        """Return the row of this tensor as part of a larger policy: the name becomes ``part.name``."""
        return self._replace(name=f"{part}.{self.name}")


class NetworkSpec(FileModel):
    """The networks of a policy: an actor, and optionally a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]. ``clip`` clips the actor's mean to the bounds (PPO's
    Gaussian, whose noise is one number per action). ``tanh`` squashes it (SAC's Gaussian, whose noise is a second head
    of the actor). Without ``value_hidden`` there is no critic: a policy needs none to act.

    ``networks`` above 1 is a mixture of experts: that many actors of this shape, and a gating network with
    ``gate_hidden`` layers that scores them. The expert with the highest score acts, the first one if scores are equal.
    The gating network is evaluated at every decision and has no memory. A mixture has neither noise nor critic.

    Output ``choice`` scores ``choices`` actions, evenly spaced from -1 to 1. The action with the highest score is
    taken, the lowest one if scores are equal. There is neither noise nor critic. The actor may also score whole
    policies, ``among``; their scores come before those of the actions, and all of them get the same observation.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]  # F, length of an observation
    action_size: Annotated[int, Field(ge=1, le=64)]  # A, length of an action
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]  # width of each hidden layer of an actor
    value_hidden: PerhapsHidden  # width of each hidden layer of the critic; empty: no critic
    activation: Activation  # function between the layers
    output: Literal["clip", "tanh", "choice"]  # what makes an action of the actor's outputs
    # number of actions that output "choice" scores; None for other outputs
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None
    # number of actors; above 1: a mixture of experts
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()  # hidden layers of the gating network
    among: Annotated[tuple[NetworkSpec, ...], Field(max_length=16, exclude_if=not_)] = ()  # policies that are scored

    @model_validator(mode="after")
    def _a_gate_between_several(self) -> NetworkSpec:
        if (self.networks > 1) != bool(self.gate_hidden):
            raise ValueError(
                f"networks = {self.networks} with gate_hidden = {list(self.gate_hidden)}; several need a gate"
            )
        if self.networks > 1 and self.value_hidden:
            raise ValueError(f"value_hidden = {list(self.value_hidden)}: must be empty beside several networks")
        if (self.output == "choice") != (self.choices is not None):
            raise ValueError(
                f"choices = {self.choices} with output {self.output}; output choice needs a number of them"
            )
        if self.choices is not None and (self.value_hidden or self.networks > 1 or self.action_size > 1):
            raise ValueError("output choice is for one network without a critic, and one action")
        for m, member in enumerate(self.among):
            if self.choices is None or member.among:
                raise ValueError("among: is for output choice, and its policies choose among no others")
            if (member.observation_size, member.action_size) != (self.observation_size, self.action_size):
                raise ValueError(
                    f"among[{m}]: observation_size and action_size are {member.observation_size} and"
                    f" {member.action_size}; must be {self.observation_size} and {self.action_size}, as beside among"
                )
        return self

    @property
    def actors(self) -> tuple[str, ...]:
        """First part of the tensor names of each actor: ``("policy",)``, or ``("network_1", "network_2", ...)``."""
        return ("policy",) if self.networks == 1 else tuple(f"network_{m + 1}" for m in range(self.networks))

    @property
    def actions(self) -> Float32s:
        """The actions that output ``choice`` scores, [choices], from -1 to 1."""
        levels: Float32s = np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)
        return levels

    @property
    def format_version(self) -> Literal[2, 3, 4, 5]:
        """Format version that the manifest of a policy with this network has."""
        if self.choices is not None:
            return 5 if self.among else 4
        return 2 if self.networks == 1 else 3

    @property
    def tensors(self) -> tuple[TensorRow, ...]:
        """Name and shape of every tensor in a bundle with this network, all float32.

        Weights are [outputs, inputs] as in ``y = W x + b``.
        """
        actors = [row for name in self.actors for row in self._network(name, self.policy_hidden, self._outputs)]
        if self.networks > 1:
            return (*actors, *self._network("gate", self.gate_hidden, self.networks))
        if self.choices is not None:
            among = (row.inside(f"among_{m}") for m, each in enumerate(self.among, 1) for row in each.tensors)
            return (*actors, *among)
        if self.output == "clip":
            actors.append(TensorRow("policy.log_std", (self.action_size,)))
        else:
            actors += _layer("policy.log_std", self.policy_hidden[-1], self.action_size)
        critic = self._network("value", self.value_hidden, 1) if self.value_hidden else []
        return (*actors, *critic)

    @property
    def _outputs(self) -> int:
        """Number of outputs of each actor: its actions, or with output ``choice`` its scores."""
        return self.action_size if self.choices is None else len(self.among) + self.choices

    def _network(self, name: str, hidden: tuple[int, ...], outputs: int) -> list[TensorRow]:
        sizes = [self.observation_size, *hidden]
        layers = [_layer(f"{name}.{k}", sizes[k], sizes[k + 1]) for k in range(len(hidden))]
        return [*chain(*layers), *_layer(f"{name}.output", sizes[-1], outputs)]


def _layer(name: str, inputs: int, outputs: int) -> list[TensorRow]:
    return [TensorRow(f"{name}.weight", (outputs, inputs)), TensorRow(f"{name}.bias", (outputs,))]


Float32s = NDArray[np.float32]
