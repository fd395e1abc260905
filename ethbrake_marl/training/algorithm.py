"""Interface of a learning algorithm: how it builds its model, and what of the model a checkpoint keeps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor
from torch.optim import Optimizer

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.training.networks import tensors_of
from ethbrake_marl.training.training import Training


class Algorithm(ABC):
    """A learning algorithm on a model of Stable-Baselines3, or on one of your own made from its ``BaseAlgorithm``.

    ``build`` is needed. The other methods say which policies a model holds, what of it changes while it learns, beside
    what every model of Stable-Baselines3 has, and what must stay a usable number. As they stand here they fit a model
    whose ``policy`` has one ``optimizer``, as in PPO and A2C.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """Return a new model on the CPU, seeded by the recipe; a function of its two arguments and of nothing else."""

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """The policies that drive: one for all learners, or under ``independent`` one for each, front to rear."""
        return (model.policy,)

    def tensors(self, actor: BasePolicy, network: NetworkSpec) -> dict[str, Float32s]:
        """Copy the weights of one of the ``actors`` under the names of a policy bundle with this network."""
        return tensors_of(actor, network)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Every optimiser by a name of its own, always in this order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Learned numbers outside the model's policy, by name; a checkpoint keeps them."""
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of the exploration noise, which must stay a usable number; None: there is nothing to check."""
        found: Tensor | None = getattr(model.policy, "log_std", None)
        return None if found is None else found.detach()
