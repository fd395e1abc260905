"""A PPO policy whose actor sees its own row and whose critic sees the whole line."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor


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
