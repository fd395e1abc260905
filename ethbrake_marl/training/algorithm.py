"""Interface of a learning algorithm: how it builds its model, and what of the model a checkpoint keeps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ethbrake_marl.training.training import Training

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv


class Algorithm(ABC):
    """A learning algorithm on a model of Stable-Baselines3, or on one of your own made from its ``BaseAlgorithm``.

    ``build`` is needed. The other methods say what a checkpoint holds and what is checked; as they stand here they fit
    a model whose ``policy`` has one ``optimizer``, as in PPO and A2C.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """A fresh model on the CPU, seeded by the recipe; a function of its two arguments and of nothing else."""

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """What drives: one for all learners, or under ``independent`` one for each, front to rear.

        Its state holds the ``tensors`` of the recipe's ``network_spec``.
        """
        return (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Every optimiser by a name of its own, always in this order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Learned numbers that stand outside the model's policy, by name; a checkpoint keeps them."""
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of how much it explores, which must stay a usable number; None: nothing to check."""
        found: Tensor | None = getattr(model.policy, "log_std", None)
        return None if found is None else found.detach()
