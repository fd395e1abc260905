"""PPO and SAC of Stable-Baselines3: the model of each scheme, and how its weights become a policy's.

Central training, decentral driving (MAPPO): all learners share an actor, and the critic sees the whole line. A row of
the environment is a vehicle's own observation and behind it the full state (``make_sb3_vec_env(...,
appended="state")``). The actor sees the first part alone, which is all that a vehicle has when it drives; the critic
sees both: the state, and whose place it judges.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.optim import Optimizer

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.learning.recipe import NetworkShape, PpoRecipe, SacRecipe, SquashedShape
from ethbrake_marl.learning.training import Algorithm, Training
from ethbrake_marl.policies.actor import Activation, Float32s, NetworkSpec, tensor_table

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in tensor_table(spec)}


class Ppo(Algorithm):
    """Stable-Baselines3's PPO: one for all learners, with a central critic, or one for each."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> PPO:
        """The model of the training's scheme."""
        recipe = training.recipe
        assert isinstance(recipe, PpoRecipe)
        settings = _settings(recipe, environment)
        if training.scheme == "independent":
            return IndependentPPO(environment, list(training.drivers), recipe.turns, **settings)
        if training.scheme == "centralised":
            settings["policy_kwargs"]["own"] = training.observation.size
            return PPO(CentralCriticPolicy, environment, **settings)
        return PPO("MlpPolicy", environment, **settings)

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """The model's policy, or the one of each independent learner."""
        return tuple(model.policy.policies) if isinstance(model, IndependentPPO) else (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """The optimiser of the model's policy, or the one of each independent learner by the vehicle's name."""
        if isinstance(model, IndependentPPO):
            return dict(zip(model.names, (member.optimizer for member in model.policy.policies), strict=True))
        return {"policy": model.policy.optimizer}


def ppo_arguments(shape: NetworkShape) -> dict[str, Any]:
    """Arguments of PPO's policy: separate actor and critic, orthogonal initial weights."""
    return {
        "net_arch": {"pi": list(shape.policy), "vf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
        "ortho_init": True,
        "log_std_init": shape.initial_log_std,
    }


def _settings(recipe: PpoRecipe, environment: EthBrakeVecEnv) -> dict[str, Any]:
    return {
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


# Independent learners: one PPO each, with a network, an optimiser and a buffer of its own, in the same worlds.
#
# A row of the environment ends with its learner's number (``make_sb3_vec_env(..., appended="number")``). Rollouts are
# collected for all of them together; then each learns from its own part, by Stable-Baselines3's own ``PPO.train``.


class SeparatePolicies(BasePolicy):
    """An actor, a critic and an optimiser for each learner; a row's last number says which of them sees the rest.

    ``resting`` learners do not explore: they act by their mean.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        lr_schedule: Schedule,
        use_sde: bool = False,
        *,
        learners: int,
        **network: Any,
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        own = Box(observation_space.low[:-1], observation_space.high[:-1], dtype=observation_space.dtype.type)
        self.members = nn.ModuleList(
            ActorCriticPolicy(own, action_space, lr_schedule, use_sde=use_sde, **network) for _ in range(learners)
        )
        self.resting: frozenset[int] = frozenset()

    @property
    def log_std(self) -> Tensor:
        """Exploration noise of all learners, one after the other."""
        return torch.cat([member.log_std for member in self.policies])

    @property
    def policies(self) -> list[ActorCriticPolicy]:
        """The learners' policies, front to rear."""
        return [member for member in self.members if isinstance(member, ActorCriticPolicy)]

    def forward(self, observation: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Actions [n, 1], values [n, 1] and log-probabilities [n] of rows [n, F + 1]."""
        count = len(observation)
        actions, values, likelihood = torch.empty(count, 1), torch.empty(count, 1), torch.empty(count)
        for number, policy, rows in self._by_learner(observation):
            still = deterministic or number in self.resting
            actions[rows], values[rows], likelihood[rows] = policy(observation[rows, :-1], still)
        return actions, values, likelihood

    def predict_values(self, observation: PyTorchObs) -> Tensor:
        """Values [n, 1] of rows [n, F + 1]."""
        assert isinstance(observation, Tensor)
        values = torch.empty(len(observation), 1)
        for _, policy, rows in self._by_learner(observation):
            values[rows] = policy.predict_values(observation[rows, :-1])
        return values

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        return self.forward(observation, deterministic)[0]

    def _by_learner(self, observation: Tensor) -> Iterator[tuple[int, ActorCriticPolicy, Tensor]]:
        numbers = observation[:, -1]
        for number, policy in enumerate(self.policies):
            rows = (numbers == number).nonzero()[:, 0]
            if len(rows):
                yield number, policy, rows


class IndependentPPO(PPO):
    """A PPO for each of the ``names`` (learners, front to rear), all at once, or in ``turns``: N rounds, one by one.

    In a turn the others drive by their means and do not learn; the turns divide the training's updates evenly. What
    is logged of the learning of ``vehicle_2`` is called ``vehicle_2/loss`` and so on.
    """

    policy: SeparatePolicies  # type: ignore[assignment]  # of an actor-critic it has what PPO asks for

    def __init__(self, env: VecEnv, names: Sequence[str], turns: int | None, **settings: Any) -> None:
        self.names, self.turns = tuple(names), turns
        arguments = {**settings.pop("policy_kwargs"), "learners": len(names)}
        super().__init__(SeparatePolicies, env, policy_kwargs=arguments, **settings)  # type: ignore[arg-type]
        self._learning: tuple[int, ...] = ()

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Collect as PPO does, those whose turn it is not without exploration."""
        everyone = range(len(self.names))
        self._learning = tuple(everyone) if self.turns is None else (self._whose_turn(self.turns),)
        self.policy.resting = frozenset(everyone) - frozenset(self._learning)
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def train(self) -> None:
        """Let each learner whose turn it is learn from its own rows, with its own optimiser."""
        joint, buffer, log, updates = self.policy, self.rollout_buffer, self._logger, self._n_updates
        parts = {number: self._part(buffer, number) for number in self._learning}
        try:
            for number, part in parts.items():
                self.policy, self.rollout_buffer = joint.policies[number], part  # type: ignore[assignment]
                self._logger, self._n_updates = Logger(None, []), updates
                super().train()
                for name, value in self._logger.name_to_value.items():
                    excluded = self._logger.name_to_excluded[name]
                    log.record(name.replace("train", self.names[number], 1), value, excluded)
        finally:
            self.policy, self.rollout_buffer, self._logger = joint, buffer, log

    def _whose_turn(self, turns: int) -> int:
        """The learner of the update that begins; a function of the steps done, so a resumed training asks nothing."""
        rollout = self.n_envs * self.n_steps
        planned = -(-self._total_timesteps // rollout)
        stretch = self.num_timesteps // rollout * turns * len(self.names) // planned
        return stretch % len(self.names)

    def _part(self, buffer: RolloutBuffer, number: int) -> RolloutBuffer:
        """What one learner has lived through, in a buffer of its own."""
        own = self.policy.policies[number].observation_space
        count = len(self.names)
        part = RolloutBuffer(
            buffer.buffer_size,
            own,
            self.action_space,
            self.device,
            gae_lambda=self.gae_lambda,
            gamma=self.gamma,
            n_envs=self.n_envs // count,
        )
        for name in ("actions", "rewards", "episode_starts", "values", "log_probs", "returns", "advantages"):
            setattr(part, name, getattr(buffer, name)[:, number::count].copy())
        part.observations = buffer.observations[:, number::count, :-1].copy()
        part.pos, part.full = buffer.buffer_size, True
        return part


class Sac(Algorithm):
    """Stable-Baselines3's SAC, one for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> SAC:
        """The model."""
        recipe = training.recipe
        assert isinstance(recipe, SacRecipe)
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

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """Those of actor and critics, and of the entropy coefficient where it is learned."""
        assert isinstance(model, SAC)
        found: dict[str, Any] = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        if model.ent_coef_optimizer is not None:
            found["ent_coef"] = model.ent_coef_optimizer
        return found

    def learned_beside(self, model: BaseAlgorithm) -> dict[str, Tensor]:
        """The logarithm of the entropy coefficient, where it is learned."""
        coefficient = self.log_noise(model)
        return {} if coefficient is None else {"log_ent_coef": coefficient}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of the entropy coefficient; None where it is fixed."""
        assert isinstance(model, SAC)
        return None if model.log_ent_coef is None else model.log_ent_coef.detach()


def sac_arguments(shape: SquashedShape) -> dict[str, Any]:
    """Arguments of SAC's policy: an actor and two critics."""
    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
    }
