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
PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]


class NetworkSpec(BaseModel):
    """An actor, and perhaps a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]: ``clip`` cuts the actor's mean at the bounds (PPO's
    Gaussian, whose noise is one number per action), ``tanh`` squashes it (SAC's Gaussian, whose noise is a second
    head of the actor). Without ``value_hidden`` there is no critic: a policy needs none to act.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    observation_size: Annotated[int, Field(ge=1, le=4096)]
    action_size: Annotated[int, Field(ge=1, le=64)]
    policy_hidden: Hidden
    value_hidden: PerhapsHidden
    activation: Activation
    output: Output


@dataclass(frozen=True, slots=True)
class TensorRow:
    """One tensor: its name in a bundle, its shape, and its name in Stable-Baselines3's policy (PPO's or SAC's)."""

    name: str
    shape: tuple[int, ...]
    sb3_name: str


def tensor_table(spec: NetworkSpec) -> tuple[TensorRow, ...]:
    """List every tensor of ``spec``, all float32; weights are [outputs, inputs] as in ``y = W x + b``."""
    last = spec.policy_hidden[-1]
    if spec.output == "clip":
        rows = [
            *_layers("policy", "mlp_extractor.policy_net", spec.observation_size, spec.policy_hidden),
            *_layer("policy.output", "action_net", last, spec.action_size),
            TensorRow("policy.log_std", (spec.action_size,), "log_std"),
        ]
    else:
        rows = [
            *_layers("policy", "actor.latent_pi", spec.observation_size, spec.policy_hidden),
            *_layer("policy.output", "actor.mu", last, spec.action_size),
            *_layer("policy.log_std", "actor.log_std", last, spec.action_size),
        ]
    if spec.value_hidden:
        rows += _layers("value", "mlp_extractor.value_net", spec.observation_size, spec.value_hidden)
        rows += _layer("value.output", "value_net", spec.value_hidden[-1], 1)
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
