"""PPO policy with a central critic: the actor sees one vehicle's observation, the critic sees the whole line."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor


class CentralCriticPolicy(ActorCriticPolicy):
    """PPO policy whose actor sees the first ``own`` entries of an observation row, and whose critic sees the whole row.

    The other arguments are those of Stable-Baselines3's ``ActorCriticPolicy``.
    """

    def __init__(self, *arguments: Any, own: int, **settings: Any) -> None:
        self._own = own  # set before ``super().__init__``, which builds the networks
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _OwnPartForTheActor(self._own, self.features_dim, self.net_arch, self.activation_fn)


class _OwnPartForTheActor(MlpExtractor):
    """Hidden layers of an actor, which sees the first ``own`` entries of an observation row, and of a critic.

    The critic sees all ``whole`` entries. The other arguments are as in Stable-Baselines3's ``ActorCriticPolicy``.
    """

    def __init__(self, own: int, whole: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(own, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(whole, net_arch, activation_fn, device="cpu").value_net
        self._own = own

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the output of the actor's last hidden layer for observation rows ``features`` [n, F]."""
        return super().forward_actor(features[:, : self._own])
