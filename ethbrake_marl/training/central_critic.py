"""PPO policy with a central critic: the actor sees its own observation, the critic sees the whole line."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor


class CentralCriticPolicy(ActorCriticPolicy):
    """PPO policy whose actor sees only the beginning of an observation row, and whose critic sees the whole row.

    Args:
        arguments: positional arguments of Stable-Baselines3's ``ActorCriticPolicy``.
        own: number of entries at the beginning of a row that the actor sees: the vehicle's own observation.
        settings: keyword arguments of ``ActorCriticPolicy``.

    """

    def __init__(self, *arguments: Any, own: int, **settings: Any) -> None:
        self._own = own  # set first, because the base class builds the networks
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _OwnPartForTheActor(self._own, self.features_dim, self.net_arch, self.activation_fn)


class _OwnPartForTheActor(MlpExtractor):
    """Hidden layers of actor and critic: the actor's take the first ``own`` entries of a row, the critic's all.

    ``whole`` is the length of a row; ``net_arch`` and ``activation_fn`` are those of Stable-Baselines3's
    ``ActorCriticPolicy``.
    """

    def __init__(self, own: int, whole: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(own, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(whole, net_arch, activation_fn, device="cpu").value_net
        self._own = own

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the output of the actor's last hidden layer for rows ``features`` [n, F]."""
        return super().forward_actor(features[:, : self._own])
