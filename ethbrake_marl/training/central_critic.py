"""PPO policy with a central critic: the actor sees one vehicle's observation, the critic sees the whole line."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor


class CentralCriticPolicy(ActorCriticPolicy):
    """PPO policy whose actor sees the first entries of an observation row, and whose critic sees the whole row.

    Args:
        arguments: positional arguments of Stable-Baselines3's ``ActorCriticPolicy``.
        own: number of entries at the beginning of an observation row that the actor sees (the vehicle's observation).
        settings: keyword arguments of ``ActorCriticPolicy``.

    """

    def __init__(self, *arguments: Any, own: int, **settings: Any) -> None:
        self._own = own  # set before ``super().__init__``, which builds the networks
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _OwnPartForTheActor(self._own, self.features_dim, self.net_arch, self.activation_fn)


class _OwnPartForTheActor(MlpExtractor):
    """Hidden layers of an actor, which sees the first entries of an observation row, and a critic, which sees all
    entries.

    Args:
        own: number of entries that the actor sees, at the beginning of an observation row.
        whole: number of all entries of an observation row; the critic sees all of them.
        net_arch: sizes of the layers, as in Stable-Baselines3's ``ActorCriticPolicy``.
        activation_fn: activation function, as in Stable-Baselines3's ``ActorCriticPolicy``.

    """

    def __init__(self, own: int, whole: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(own, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(whole, net_arch, activation_fn, device="cpu").value_net
        self._own = own

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the output of the actor's last hidden layer for observation rows ``features`` [n, F]."""
        return super().forward_actor(features[:, : self._own])
