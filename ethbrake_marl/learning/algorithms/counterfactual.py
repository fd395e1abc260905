"""Learning from exact counterfactuals: its recipes, and the algorithm (``counterfactual_model`` has the model)."""

# Stable-Baselines3 is imported where a model is built: it loads torch, which takes seconds, and a recipe needs neither.

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.recipe import ActorShape, Fraction, OffsetRange, Positive, Rate, TrainingRecipe
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.manifest import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.shipped import PolicyKind, load_named_policy
from ethbrake_marl.scenario.checks import refuse

if TYPE_CHECKING:
    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
    from ethbrake_marl.learning.algorithms.counterfactual_model import CounterfactualModel

MOMENTS_LIMIT = 2**22  # decisions held in memory between two updates
_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)}


Steps = Annotated[int, Field(ge=1, le=1000)]


class CounterfactualRecipe(TrainingRecipe):
    """Try ``counterfactuals`` of the ``n_envs x n_steps`` decisions of a round otherwise, then learn from all of them.

    ``start`` names a policy to go on from; without one it begins with random weights.
    """

    algorithm: Literal["counterfactual"]
    start: Annotated[str, Field(pattern=r"^(ppo|counterfactual|universal)@.+$", max_length=4096)] | None = None
    n_steps: Annotated[int, Field(ge=1)]
    counterfactuals: Annotated[int, Field(ge=1)]
    offset: OffsetRange
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    gradient_limit: Positive
    trust_radius: Rate
    anchor: Positive
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Fraction
    network: ActorShape

    @model_validator(mode="after")
    def _counts_to_the_end(self) -> CounterfactualRecipe:
        if self.reward.shaping > 0.0:
            right = "must be 0: a counterfactual is played to the end, where shaping tells nothing more"
            refuse(("reward", "shaping"), self.reward.shaping, right)
        return self

    @model_validator(mode="after")
    def _enough_decisions(self) -> CounterfactualRecipe:
        visited = self.n_envs * self.n_steps
        if not visited <= MOMENTS_LIMIT:
            right = f"n_envs x n_steps = {visited} decisions per update; at most {MOMENTS_LIMIT}"
            refuse(("n_envs",), self.n_envs, right)
        if not self.counterfactuals <= visited:
            refuse(("counterfactuals",), self.counterfactuals, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor alone."""
        return self.network.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.n_steps


class Counterfactual(Algorithm):
    """Gradients of the return by playing on from the same moment in two ways; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> CounterfactualModel:
        """The model, from the policy of ``start`` if the recipe names one."""
        from ethbrake_marl.engine.branches import branch, moment_of
        from ethbrake_marl.learning.algorithms.counterfactual_model import CounterfactualModel, TryingOut

        recipe = training.recipe
        assert isinstance(recipe, CounterfactualRecipe)
        branch(environment.engine, moment_of(environment.engine))  # refuses what cannot be branched before it begins
        how = TryingOut(
            recipe.n_steps,
            recipe.counterfactuals,
            (recipe.offset.smallest, recipe.offset.largest),
            recipe.holds,
            recipe.gamma,
            recipe.gradient_limit,
            recipe.trust_radius,
            recipe.anchor,
            recipe.n_epochs,
            recipe.batch_size,
            recipe.averaging,
        )
        model = CounterfactualModel(
            environment, recipe.network, how, learning_rate=recipe.learning_rate.at, seed=recipe.seed
        )
        if recipe.start is not None:
            model.policy.take_over(widened(starting_policy(recipe.start, training), training))
        return model


def starting_policy(start: str, training: Training) -> Policy:
    """The policy that ``ppo@PATH``, ``ppo@shipped`` or ``universal@shipped`` names for a training's scenario."""
    kind, _, path = start.partition("@")
    return load_named_policy(path, _KINDS[kind], training.scenario, training.recipe.reward.harm_count)


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """The actor's tensors of ``policy`` for what the training observes; features that are new to it count for nothing.

    Raises ``InvalidInput`` where the training does not observe all that the policy does, or has another network.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    found = policy.manifest.network
    same = ("policy_hidden", "activation", "output")
    for name in same:
        if getattr(found, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network: {name} is {getattr(wanted, name)}, but {getattr(found, name)} in the"
                " policy to start from; they must be the same"
            )
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {recipe.name!r}: observation: lacks {', '.join(missing[:5])}, which the policy to start from"
            " observes; list what it observes, and more"
        )
    tensors = {name: tensor.copy() for name, tensor in policy.tensors.items() if name.startswith("policy.")}
    first = np.zeros((wanted.policy_hidden[0], len(names)), np.float32)
    first[:, [names.index(name) for name in known]] = tensors["policy.0.weight"]
    return {**tensors, "policy.0.weight": first}
