"""Interface of a learning algorithm: how it builds its model, and which parts of that model a checkpoint saves."""

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
    """Base class of a learning algorithm whose model is a ``BaseAlgorithm`` of Stable-Baselines3.

    A subclass must implement ``build``, which returns the model. It may override ``actors`` and ``tensors`` (the
    policies inside the model, and their weights), ``optimizers`` and ``learned_beside`` (what a checkpoint saves
    besides ``model.policy``), and ``log_noise`` (which must stay finite). The defaults fit a model whose ``policy`` has
    one ``optimizer``, as in PPO and A2C.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """Return a new model on the CPU, seeded by the recipe.

        The model must depend on the two arguments only.

        Args:
            training: recipe and scenario.
            environment: vectorised environment to learn in, with one row for each learner of each world.

        """

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """Return the policies of Stable-Baselines3 inside the model that choose actions.

        This is one policy for all learners, or, in the scheme ``independent``, one for each learner, front to rear.
        """
        return (model.policy,)

    def tensors(self, actor: BasePolicy, network: NetworkSpec) -> dict[str, Float32s]:
        """Return a copy of the weights of one of ``actors``, by their names in a policy bundle with this network."""
        return tensors_of(actor, network)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Return every optimiser of the model by a unique name, always in the same order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Return learned tensors outside ``model.policy``, by name, which a checkpoint saves too; by default none.

        SAC returns ``{"log_ent_coef": ...}``, the entropy coefficient that it learns.
        """
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """Return the logarithm of the model's exploration noise, which is checked to stay finite during the training.

        None if there is nothing to check.
        """
        log_std: Tensor | None = getattr(model.policy, "log_std", None)
        return None if log_std is None else log_std.detach()
