"""The networks of a policy: their sizes, and the table of their tensors."""

from __future__ import annotations

from itertools import chain
from operator import not_
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ethbrake_marl.files.yaml import FileModel

Activation = Literal["relu", "tanh"]

Width = Annotated[int, Field(ge=1, le=4096)]

PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]


class TensorRow(NamedTuple):
    """One tensor: its name in a bundle, its shape, and its name in Stable-Baselines3's policy (PPO's or SAC's)."""

    name: str
    shape: tuple[int, ...]
    sb3_name: str


class NetworkSpec(FileModel):
    """An actor, and perhaps a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]: ``clip`` cuts the actor's mean at the bounds (PPO's
    Gaussian, whose noise is one number per action), ``tanh`` squashes it (SAC's Gaussian, whose noise is a second
    head of the actor). Without ``value_hidden`` there is no critic: a policy needs none to act.

    With ``networks`` above 1 there are as many actors of this shape, and a gate with ``gate_hidden`` layers that gives
    each a score: the actor of the highest score acts, the first of equal ones. The gate is asked at each decision and
    remembers nothing. There is neither noise nor critic then.

    With output ``choice`` the actor gives each of ``choices`` actions, evenly from -1 to 1, a score, and the action of
    the highest one is taken, the lowest of equal ones. Again there is neither noise nor critic. Where it chooses
    ``among`` whole policies, too, their scores come before those of the actions, and all see the same observation.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]
    action_size: Annotated[int, Field(ge=1, le=64)]
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]
    value_hidden: PerhapsHidden
    activation: Activation
    output: Literal["clip", "tanh", "choice"]
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()
    among: Annotated[tuple[NetworkSpec, ...], Field(max_length=16, exclude_if=not_)] = ()

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
                raise ValueError(f"among[{m}]: observes or acts in another size; must be the same in all")
        return self

    @property
    def actors(self) -> tuple[str, ...]:
        """How the tensors' names of each actor begin."""
        return ("policy",) if self.networks == 1 else tuple(f"network_{m + 1}" for m in range(self.networks))

    @property
    def actions(self) -> Float32s:
        """Those among which output ``choice`` chooses, [choices]."""
        found: Float32s = np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)
        return found

    @property
    def format_version(self) -> Literal[2, 3, 4, 5]:
        """Of a bundle with this network."""
        if self.choices is not None:
            return 5 if self.among else 4
        return 2 if self.networks == 1 else 3

    @property
    def tensors(self) -> tuple[TensorRow, ...]:
        """Every tensor, all float32; weights are [outputs, inputs] as in ``y = W x + b``.

        The training library counts activations too, so the index of its layers is twice ours.
        """

        def layer(name: str, sb3_name: str, inputs: int, outputs: int) -> list[TensorRow]:
            return [
                TensorRow(f"{name}.weight", (outputs, inputs), f"{sb3_name}.weight"),
                TensorRow(f"{name}.bias", (outputs,), f"{sb3_name}.bias"),
            ]

        def network(name: str, sb3_name: str, hidden: tuple[int, ...], sb3_head: str, outputs: int) -> list[TensorRow]:
            sizes = [self.observation_size, *hidden]
            layers = [layer(f"{name}.{k}", f"{sb3_name}.{2 * k}", sizes[k], sizes[k + 1]) for k in range(len(hidden))]
            return [*chain(*layers), *layer(f"{name}.output", sb3_head, sizes[-1], outputs)]

        hidden, actions = self.policy_hidden, self.action_size
        if self.networks > 1:
            gate = network(
                "gate", "gate.average", self.gate_hidden, f"gate.average.{2 * len(self.gate_hidden)}", self.networks
            )
            actors = [
                network(name, f"members.{m}.mlp_extractor.policy_net", hidden, f"members.{m}.action_net", actions)
                for m, name in enumerate(self.actors)
            ]
            return (*chain(*actors), *gate)
        if self.choices is not None:
            scores = len(self.among) + self.choices
            chooser = network("policy", "average", hidden, f"average.{2 * len(hidden)}", scores)
            for m, each in enumerate(self.among, 1):
                named = ((f"among_{m}.{row.name}", row.shape) for row in each.tensors)
                chooser += [TensorRow(name, shape, name.replace(".", "_")) for name, shape in named]
            return tuple(chooser)
        if self.output == "clip":
            rows = network("policy", "mlp_extractor.policy_net", hidden, "action_net", actions)
            rows.append(TensorRow("policy.log_std", (actions,), "log_std"))
        else:
            rows = network("policy", "actor.latent_pi", hidden, "actor.mu", actions)
            rows += layer("policy.log_std", "actor.log_std", hidden[-1], actions)
        if self.value_hidden:
            rows += network("value", "mlp_extractor.value_net", self.value_hidden, "value_net", 1)
        return tuple(rows)


Float32s = NDArray[np.float32]
