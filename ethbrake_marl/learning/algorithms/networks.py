"""Networks for Stable-Baselines3: a central critic, and how its weights become a policy's.

Central training, decentral driving (MAPPO): all learners share an actor, and the critic sees the whole line. A row of
the environment is a vehicle's own observation and behind it the full state (``make_sb3_vec_env(...,
appended="state")``). The actor sees the first part alone, which is all that a vehicle has when it drives; the critic
sees both: the state, and whose place it judges.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor, nn

from ethbrake_marl.policies.actor import Float32s
from ethbrake_marl.policies.manifest import Activation, NetworkSpec, tensor_table

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


class Adam(torch.optim.Adam):
    """torch's, to the bit, without what imports torch's compiler (1 to 3 CPU-s), which has nothing to do here."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


class CentralCriticPolicy(ActorCriticPolicy):
    """PPO's policy with an actor on the first ``own`` numbers of a row and a critic on all of them."""

    def __init__(self, *arguments: Any, own: int, **settings: Any) -> None:
        self._own = own  # before the networks are built
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _OwnPartForTheActor(self._own, self.features_dim, self.net_arch, self.activation_fn)


class _OwnPartForTheActor(MlpExtractor):
    """The hidden layers of both."""

    def __init__(self, own: int, whole: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(own, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(whole, net_arch, activation_fn, device="cpu").value_net
        self._own = own

    def forward_actor(self, features: Tensor) -> Tensor:
        """The actor's last hidden layer."""
        return super().forward_actor(features[:, : self._own])


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in tensor_table(spec)}
