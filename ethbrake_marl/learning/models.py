"""From a training to its model, and from a model's present weights to policies."""

from __future__ import annotations

from collections.abc import Callable

from stable_baselines3.common.policies import BasePolicy

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.algorithms.networks import tensors_of
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.model_state import Model
from ethbrake_marl.learning.progress import watch_gradients
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.manifest import installed_versions, observation_schema
from ethbrake_marl.policies.policy import Policy, make_policy
from ethbrake_marl.policies.team import PolicyTeam, Trained


def make_model(algorithm: Algorithm, training: Training, environment: EthBrakeVecEnv) -> Model:
    """The model of a training, whose optimisers refuse gradients that are not finite."""
    model = algorithm.build(training, environment)
    if getattr(model, "get_vec_normalize_env", lambda: None)() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model is trained under VecNormalize, whose statistics are no"
            " part of a policy bundle; observations here are scaled already"
        )
    watch_gradients(model, algorithm)
    return model


def policy_maker(algorithm: Algorithm, training: Training) -> Callable[[Model], Trained]:
    """How to make policies of a model's present weights: one for all learners, or one for each."""
    recipe, scenario, observation = training.recipe, training.scenario, training.observation
    network = recipe.network_spec(observation.size)
    if training.scheme == "centralised":
        network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
    names = tuple(training.drivers)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(observation),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
        "versions": installed_versions(),
    }

    def make(actor: BasePolicy, learners: tuple[str, ...], steps: int) -> Policy:
        return make_policy(tensors_of(actor, network), learners=learners, steps=steps, **fixed)

    def policies(model: Model) -> Trained:
        actors = algorithm.actors(model)
        if training.scheme != "independent":
            (actor,) = actors
            return make(actor, names, model.num_timesteps)
        members = zip(names, actors, strict=True)
        return PolicyTeam({name: make(actor, (name,), model.num_timesteps) for name, actor in members})

    return policies
