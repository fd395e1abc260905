"""The networks of a policy: sizes, and names and shapes of the tensors."""

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
        """Return this row with ``part.`` in front of the tensor's name, for a policy inside another policy."""
        return self._replace(name=f"{part}.{self.name}")


class NetworkSpec(FileModel):
    """The networks of a policy: an actor, and optionally a critic, both multilayer perceptrons on the same observation.

    The key ``output`` says how the actor's result becomes an action in [-1, 1]. Output ``clip`` clips the actor's
    result to [-1, 1]; in training (PPO) this result is the mean of a Gaussian with one noise parameter per action.
    Output ``tanh`` applies tanh to the actor's result; in training (SAC) the actor's result is the mean of a Gaussian
    whose noise comes from a second head of the actor. If ``value_hidden`` is empty, there is no critic; a policy can
    act without a critic.

    If ``networks`` is above 1, the policy is a mixture of experts. It has ``networks`` actors of the same shape, and a
    gating network (hidden layers ``gate_hidden``) that gives each actor a score at every decision. The actor with the
    highest score acts; among equal scores, the first actor acts. A mixture of experts has no noise and no critic.

    With output ``choice`` the actor computes a score for each of ``choices`` actions, which are evenly spaced from -1
    to 1. The policy takes the action with the highest score; among equal scores, it takes the lowest action. A policy
    with output ``choice`` has no noise and no critic. Its actor may also compute a score for each of several other
    policies (``among``) that act on the same observation; if a policy has the highest score, it chooses the action. In
    the actor's result, the scores of the policies in ``among`` come before the scores of the fixed actions.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]  # F, length of an observation
    action_size: Annotated[int, Field(ge=1, le=64)]  # A, length of an action
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]  # width of each hidden layer of an actor
    value_hidden: PerhapsHidden  # width of each hidden layer of the critic; empty: no critic
    activation: Activation  # function between the layers
    output: Literal["clip", "tanh", "choice"]  # function from the actor's outputs to the action
    # number of actions that output "choice" scores; None for other outputs
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None
    # number of actors; above 1: a mixture of experts
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()  # hidden layers of the gating network
    among: Annotated[tuple[NetworkSpec, ...], Field(max_length=16, exclude_if=not_)] = ()  # policies that are scored

    @model_validator(mode="after")
    def _settings_fit(self) -> NetworkSpec:
        if (self.networks > 1) != bool(self.gate_hidden):
            raise ValueError(
                f"gate_hidden = {list(self.gate_hidden)}: must have a layer if networks is above 1, and must be left"
                f" out if networks is 1; networks is {self.networks}"
            )
        if self.networks > 1 and self.value_hidden:
            raise ValueError(f"value_hidden = {list(self.value_hidden)}: must be empty if networks is above 1")
        if (self.output == "choice") != (self.choices is not None):
            raise ValueError(
                f"choices = {self.choices}: must be a number if output is 'choice', and must be left out otherwise;"
                f" output is {self.output!r}"
            )
        if self.choices is not None and (self.value_hidden or self.networks > 1 or self.action_size > 1):
            raise ValueError("output = 'choice': needs networks = 1, action_size = 1 and an empty value_hidden")
        for m, member in enumerate(self.among):
            if self.choices is None or member.among:
                raise ValueError(
                    "among: needs output = 'choice', and a policy in this list must not have a key among of its own"
                )
            if (member.observation_size, member.action_size) != (self.observation_size, self.action_size):
                raise ValueError(
                    f"among[{m}]: observation_size and action_size are {member.observation_size} and"
                    f" {member.action_size}; must be {self.observation_size} and {self.action_size}, as for the network"
                    " that chooses among these policies"
                )
        return self

    @property
    def actors(self) -> tuple[str, ...]:
        """Beginning of each actor's tensor names: ``("policy",)``, or ``("network_1", "network_2", ...)``."""
        return ("policy",) if self.networks == 1 else tuple(f"network_{m + 1}" for m in range(self.networks))

    @property
    def actions(self) -> Float32s:
        """Fixed actions that output ``choice`` scores, [choices], from -1 to 1."""
        levels: Float32s = np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)
        return levels

    @property
    def format_version(self) -> Literal[2, 3, 4, 5]:
        """Version of the manifest format for a policy with this network."""
        if self.choices is not None:
            return 5 if self.among else 4
        return 2 if self.networks == 1 else 3

    @property
    def tensors(self) -> tuple[TensorRow, ...]:
        """Name and shape of every float32 tensor in a bundle with this network.

        The shape of weights is (outputs, inputs), as in ``y = W x + b``.
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
        """Number of outputs of each actor."""
        return self.action_size if self.choices is None else len(self.among) + self.choices

    def _network(self, name: str, hidden: tuple[int, ...], outputs: int) -> list[TensorRow]:
        sizes = [self.observation_size, *hidden]
        layers = [_layer(f"{name}.{k}", sizes[k], sizes[k + 1]) for k in range(len(hidden))]
        return [*chain(*layers), *_layer(f"{name}.output", sizes[-1], outputs)]


def _layer(name: str, inputs: int, outputs: int) -> list[TensorRow]:
    return [TensorRow(f"{name}.weight", (outputs, inputs)), TensorRow(f"{name}.bias", (outputs,))]


Float32s = NDArray[np.float32]
