"""What a policy network looks like, and which tensors it therefore has.

The table is ours: a bundle is checked against it before a single weight is used, and the training library's
own names appear in one column only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Activation = Literal["relu", "tanh"]
Output = Literal["clip", "tanh"]
Width = Annotated[int, Field(ge=1, le=4096)]
Hidden = Annotated[tuple[Width, ...], Field(min_length=1, max_length=8)]


class NetworkSpec(BaseModel):
    """An actor and a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]: ``clip`` cuts the actor's mean at the bounds (PPO's
    Gaussian), ``tanh`` squashes it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    observation_size: Annotated[int, Field(ge=1, le=4096)]
    action_size: Annotated[int, Field(ge=1, le=64)]
    policy_hidden: Hidden
    value_hidden: Hidden
    activation: Activation
    output: Output


@dataclass(frozen=True, slots=True)
class TensorRow:
    """One tensor: its name in a bundle, its shape, and its name in Stable-Baselines3's ``ActorCriticPolicy``."""

    name: str
    shape: tuple[int, ...]
    sb3_name: str


def tensor_table(spec: NetworkSpec) -> tuple[TensorRow, ...]:
    """List every tensor of ``spec``, all float32; weights are [outputs, inputs] as in ``y = W x + b``."""
    rows = [
        *_layers("policy", "mlp_extractor.policy_net", spec.observation_size, spec.policy_hidden),
        *_layer("policy.output", "action_net", spec.policy_hidden[-1], spec.action_size),
        TensorRow("policy.log_std", (spec.action_size,), "log_std"),
        *_layers("value", "mlp_extractor.value_net", spec.observation_size, spec.value_hidden),
        *_layer("value.output", "value_net", spec.value_hidden[-1], 1),
    ]
    return tuple(rows)


def _layers(name: str, sb3_name: str, inputs: int, hidden: tuple[int, ...]) -> list[TensorRow]:
    """Hidden layers; the training library counts activations too, so its index is twice ours."""
    rows: list[TensorRow] = []
    for k, width in enumerate(hidden):
        rows += _layer(f"{name}.{k}", f"{sb3_name}.{2 * k}", inputs, width)
        inputs = width
    return rows


def _layer(name: str, sb3_name: str, inputs: int, outputs: int) -> list[TensorRow]:
    return [
        TensorRow(f"{name}.weight", (outputs, inputs), f"{sb3_name}.weight"),
        TensorRow(f"{name}.bias", (outputs,), f"{sb3_name}.bias"),
    ]
