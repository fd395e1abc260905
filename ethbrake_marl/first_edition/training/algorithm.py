"""Interface of a learning algorithm: how it builds a model, and what a checkpoint saves of the model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor
from torch.optim import Optimizer

from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.networks import tensors_of
from ethbrake_marl.first_edition.training.training import Training


class Algorithm(ABC):
    """Base class of a learning algorithm whose model is a ``BaseAlgorithm`` of Stable-Baselines3.

    A subclass must implement ``build``. The other methods fit a model whose attribute ``policy`` has one ``optimizer``,
    such as PPO and A2C; a subclass for another model overrides them.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """Return a new model on the CPU, whose random numbers depend on the recipe's seed only.

        ``environment`` has one row for each learner in each world.
        """

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """Return the policies inside the model that choose actions.

        There is one policy for all learners or, in the scheme ``independent``, one for each learner, front to rear.
        """
        return (model.policy,)

    def tensors(self, actor: BasePolicy, network: NetworkSpec) -> dict[str, Float32s]:
        """Return a copy of the weights of ``actor``: name of a tensor in a policy bundle -> its values.

        ``actor`` is one of ``actors``, and ``network`` the description of its network in the policy bundle.
        """
        return tensors_of(actor, network)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Return all optimisers of the model by name, always in the same order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Return the learned tensors outside ``model.policy``, by name, which a checkpoint must save; by default none.

        For instance, SAC returns ``{"log_ent_coef": ...}``, because it learns its entropy coefficient.
        """
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """Return the logarithm of the model's exploration noise, or None if the model has no such noise.

        If the noise is not finite or not above 0, the training run stops with an error.
        """
        log_std: Tensor | None = getattr(model.policy, "log_std", None)
        return None if log_std is None else log_std.detach()
