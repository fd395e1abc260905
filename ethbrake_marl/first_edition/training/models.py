"""Build the environment and the model of a training run, and create policies from the model's weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.first_edition.game.full_state import Appended
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.teams import PolicyTeam, Trained
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.finite import refuse_gradients
from ethbrake_marl.first_edition.training.recipe import Scheme
from ethbrake_marl.first_edition.training.training import Training

Model = BaseAlgorithm  # a model of Stable-Baselines3


class Learner(NamedTuple):
    """A model that learns, the learning algorithm of the model, and the recipe and scenario of the training."""

    training: Training  # recipe and scenario
    algorithm: Algorithm  # algorithm of the model, which reads its policies, optimisers and other learned tensors
    model: Model  # the model of Stable-Baselines3

    def policies(self) -> Trained:
        """Return a copy of the current policy or, in the scheme ``independent``, of each learner's current policy."""
        actors = self.algorithm.actors(self.model)
        return make_policies(
            self.training, self.model.num_timesteps, lambda k, network: self.algorithm.tensors(actors[k], network)
        )


def make_environment(training: Training) -> EthBrakeVecEnv:
    """Build the vectorised environment for a training run, with one row for each learner in each world."""
    recipe = training.recipe
    appended: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}
    return make_sb3_vec_env(
        training.scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=training.observation,
        horizon_is_end=recipe.horizon_is_end,
        appended=appended.get(training.scheme),
    )


def make_model(algorithm: Algorithm, training: Training, environment: EthBrakeVecEnv) -> Model:
    """Build the model of a training run. The optimisers raise ``TrainingDiverged`` for gradients that are not finite.

    Raises ``InvalidInput`` if the model normalises observations with ``VecNormalize``.
    """
    model = algorithm.build(training, environment)
    if getattr(model, "get_vec_normalize_env", lambda: None)() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model uses VecNormalize, whose statistics a policy bundle"
            " does not contain; build the model without VecNormalize, since observations are already scaled"
        )
    refuse_gradients(model, algorithm)
    return model


def make_policies(
    training: Training, steps: int, tensors: Callable[[int, NetworkSpec], Mapping[str, Float32s]]
) -> Trained:
    """Return one policy for all learners, or one policy for each learner in the scheme ``independent``.

    The policies record ``steps``, the number of decisions from which the weights were learned. ``tensors`` takes the
    number k of a policy (0 = foremost learner) and the description of its network, and returns the weights of the
    policy by name.
    """
    recipe, scenario = training.recipe, training.scenario
    names = tuple(training.drivers)
    apart = training.scheme == "independent"
    policies = []
    for k, learners in enumerate([(name,) for name in names] if apart else [names]):
        observation = training.observations[learners[0]]
        network = recipe.network_spec(observation.size)
        if training.scheme == "centralised":
            network = network.model_copy(update={"value_hidden": ()})  # a vehicle cannot use the critic
        policy = Policy.make(
            tensors(k, network),
            algorithm=recipe.algorithm,
            network=network,
            observation=observation,
            learners=learners,
            scenario=scenario.model_dump(mode="json"),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=steps,
        )
        policies.append(policy)
    return PolicyTeam(dict(zip(names, policies, strict=True))) if apart else policies[0]
