"""Central training, decentral driving (MAPPO): all learners share an actor, and the critic sees the whole line.

A row of the environment is a vehicle's own observation and behind it the full state
(``make_sb3_vec_env(..., appended="state")``). The actor sees the first part alone, which is all that a vehicle has when
it drives; the critic sees both: the state, and whose place it judges.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor, nn

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.independent import IndependentPPO
from ethbrake_marl.learning.model_state import Model
from ethbrake_marl.learning.progress import watch_gradients
from ethbrake_marl.learning.recipe import NetworkShape, PpoRecipe, SacRecipe, Scheme, SquashedShape, TrainingRecipe
from ethbrake_marl.learning.schemes import scheme_of
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.policies.actor import Float32s
from ethbrake_marl.policies.manifest import (
    Activation,
    NetworkSpec,
    installed_versions,
    observation_schema,
    tensor_table,
)
from ethbrake_marl.policies.policy import Policy, make_policy
from ethbrake_marl.policies.team import PolicyTeam, Trained
from ethbrake_marl.scenario import Scenario


class CentralCriticPolicy(ActorCriticPolicy):
    """PPO's policy with an actor on the first ``own`` numbers of a row and a critic on all of them."""

    def __init__(self, *arguments: Any, own: int, **settings: Any) -> None:
        self._own = own  # before the networks are built
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _OwnPartForTheActor(self._own, self.features_dim, self.net_arch, self.activation_fn)


class _OwnPartForTheActor(MlpExtractor):
    """The hidden layers of both."""

    def __init__(self, own: int, whole: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__(own, net_arch, activation_fn, device="cpu")
        self.value_net = MlpExtractor(whole, net_arch, activation_fn, device="cpu").value_net
        self._own = own

    def forward_actor(self, features: Tensor) -> Tensor:
        """The actor's last hidden layer."""
        return super().forward_actor(features[:, : self._own])


_ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Arguments of PPO's policy: separate actor and critic, orthogonal initial weights."""
    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": _ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }


def sac_arguments(shape: SquashedShape) -> dict[str, Any]:
    """Arguments of SAC's policy: an actor and two critics."""
    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": _ACTIVATIONS[shape.activation],
    }


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in tensor_table(spec)}


def make_model(recipe: TrainingRecipe, environment: EthBrakeVecEnv) -> Model:
    """The model that ``recipe`` asks for, on the CPU, whose optimisers refuse gradients that are not finite."""
    assert isinstance(recipe, PpoRecipe | SacRecipe)
    scheme = scheme_of(recipe, environment.engine.scenario)
    model = _ppo(recipe, environment, scheme) if isinstance(recipe, PpoRecipe) else _sac(recipe, environment)
    watch_gradients(model)
    return model


def policy_maker(
    recipe: TrainingRecipe, scenario: Scenario, observation: ObservationSpec
) -> Callable[[Model], Trained]:
    """How to make policies of a model's present weights: one for all learners, or one for each."""
    network = recipe.network_spec(observation.size)
    if scheme_of(recipe, scenario) == "centralised":
        network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
    names = tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(observation),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed},
        "versions": installed_versions(),
    }

    def made(policy: BasePolicy, learners: tuple[str, ...], steps: int) -> Policy:
        return make_policy(tensors_of(policy, network), learners=learners, steps=steps, **fixed)

    def policies(model: Model) -> Trained:
        if not isinstance(model, IndependentPPO):
            return made(model.policy, names, model.num_timesteps)
        members = zip(names, model.policy.policies, strict=True)
        return PolicyTeam({name: made(policy, (name,), model.num_timesteps) for name, policy in members})

    return policies


def _ppo(recipe: PpoRecipe, environment: EthBrakeVecEnv, scheme: Scheme) -> PPO:
    settings: dict[str, Any] = {
        "learning_rate": recipe.learning_rate.at,
        "n_steps": recipe.n_steps,
        "batch_size": recipe.batch_size,
        "n_epochs": recipe.n_epochs,
        "gamma": recipe.gamma,
        "gae_lambda": recipe.gae_lambda,
        "clip_range": recipe.clip_range,
        "ent_coef": recipe.ent_coef,
        "vf_coef": recipe.vf_coef,
        "max_grad_norm": recipe.max_grad_norm,
        "target_kl": recipe.target_kl,
        "stats_window_size": max(100, environment.num_envs),
        "policy_kwargs": ppo_arguments(recipe.network),
        "seed": recipe.seed,
        "device": "cpu",
    }
    engine = environment.engine
    if scheme == "independent":
        names = [engine.scenario.vehicle_names[vehicle] for vehicle in engine.learners]
        _check_turns(recipe, environment.num_envs, len(names))
        return IndependentPPO(environment, names, recipe.turns, **settings)
    if scheme == "centralised":
        settings["policy_kwargs"]["own"] = engine.observation.size
        return PPO(CentralCriticPolicy, environment, **settings)
    return PPO("MlpPolicy", environment, **settings)


def _check_turns(recipe: PpoRecipe, rows: int, learners: int) -> None:
    """Every turn needs an update of its own."""
    updates = -(-recipe.total_steps // (rows * recipe.n_steps))
    if recipe.turns is not None and recipe.turns * learners > updates:
        raise InvalidInput(
            f"recipe {recipe.name!r}: turns = {recipe.turns}: {learners} learners need {recipe.turns * learners}"
            f" updates, total_steps = {recipe.total_steps} are {updates}"
        )


def _sac(recipe: SacRecipe, environment: EthBrakeVecEnv) -> SAC:
    automatic = recipe.ent_coef == "auto"
    return SAC(
        "MlpPolicy",
        environment,
        learning_rate=recipe.learning_rate.at,
        buffer_size=recipe.buffer_size,
        learning_starts=recipe.learning_starts,
        batch_size=recipe.batch_size,
        tau=recipe.tau,
        gamma=recipe.gamma,
        train_freq=(recipe.steps_per_update, "step"),
        gradient_steps=recipe.gradient_steps,
        ent_coef=f"auto_{recipe.initial_ent_coef!r}" if automatic else recipe.ent_coef,
        target_update_interval=recipe.target_update_interval,
        target_entropy="auto" if recipe.target_entropy is None else recipe.target_entropy,
        stats_window_size=max(100, environment.num_envs),
        policy_kwargs=sac_arguments(recipe.network),
        seed=recipe.seed,
        device="cpu",
    )
