"""Learning from exact counterfactuals: its recipes, and the algorithm (``counterfactual_model`` has the model)."""

# Stable-Baselines3 is imported where a model is built: it loads torch, which takes seconds, and a recipe needs neither.

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.algorithms.protocol import Algorithm, ModesPlan
from ethbrake_marl.learning.recipe import ActorShape, Fraction, OffsetRange, Positive, Rate, TrainingRecipe
from ethbrake_marl.learning.training import Training
from ethbrake_marl.policies.actor import NetworkSpec
from ethbrake_marl.policies.bundle import Policy
from ethbrake_marl.policies.shipped import PolicyKind, load_named_policy
from ethbrake_marl.scenario.schema import refuse

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
    from ethbrake_marl.learning.algorithms.counterfactual_model import CounterfactualModel

MOMENTS_LIMIT = 2**22  # decisions held in memory between two updates
_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)}


def _none(value: object) -> bool:
    return value is None


def _zero(value: float) -> bool:
    return value == 0.0


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
    focus: Annotated[float, Field(ge=0.0, le=0.99, exclude_if=_zero)] = (
        0.0  # share of what is tried that a scout chooses
    )
    network: ActorShape
    modes: Annotated[ModesPlan | None, Field(exclude_if=_none)] = None  # several networks and a gate

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
        """The actor alone, or several and a gate."""
        spec = self.network.spec(observation_size)
        if self.modes is None:
            return spec
        return NetworkSpec(**spec.model_dump() | {"networks": self.modes.networks, "gate_hidden": self.modes.gate})

    def check_learners(self, learners: int) -> None:
        """Several networks are for one learner: a mode of several would have to be chosen by all of them at once."""
        if self.modes is not None and learners != 1:
            raise InvalidInput(f"recipe {self.name!r}: modes: are for one learner, not for {learners}; leave modes out")

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.n_steps


class Counterfactual(Algorithm):
    """Gradients of the return by playing on from the same moment in two ways; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> CounterfactualModel:
        """The model, from the policy of ``start`` if the recipe names one."""
        from ethbrake_marl.engine.snapshot import branch, moment_of
        from ethbrake_marl.learning.algorithms.counterfactual_model import CounterfactualModel, TryingOut
        from ethbrake_marl.learning.algorithms.modes_model import ModesModel

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
            recipe.focus,
        )
        settings: dict[str, Any] = {"learning_rate": recipe.learning_rate.at, "seed": recipe.seed}
        model: CounterfactualModel
        if recipe.modes is None:
            model = CounterfactualModel(environment, recipe.network, how, **settings)
            first = model.policy
        else:
            model = ModesModel(environment, recipe.network, how, recipe.modes, **settings)
            first = model.policy.member(0)
        if recipe.start is not None:
            first.take_over(widened(starting_policy(recipe.start, training), training))
        return model

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """The optimiser of the actor, or that of each network and of the gate."""
        from ethbrake_marl.learning.algorithms.modes_model import ModesModel

        if not isinstance(model, ModesModel):
            return {"policy": model.policy.optimizer}
        policy = model.policy
        members = {f"network_{k + 1}": policy.member(k).optimizer for k in range(model.plan.networks)}
        return {**members, "gate": policy.gate.optimizer}


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
    if found.networks > 1:
        raise InvalidInput(f"recipe {recipe.name!r}: start: has {found.networks} networks; give a policy of one")
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
