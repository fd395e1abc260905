"""PPO and SAC of Stable-Baselines3: the model of each scheme, and how its weights become a policy's.

Central training, decentral driving (MAPPO): all learners share an actor, and the critic sees the whole line. A row of
the environment is a vehicle's own observation and behind it the full state (``make_sb3_vec_env(...,
appended="state")``). The actor sees the first part alone, which is all that a vehicle has when it drives; the critic
sees both: the state, and whose place it judges.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch
from gymnasium.spaces import Box, Space, flatdim
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor, create_mlp
from stable_baselines3.common.type_aliases import MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.nn.functional import mse_loss, softplus
from torch.optim import Optimizer

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.engine import Engine, Moment
from ethbrake_marl.envs import EthBrakeVecEnv
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.training import (
    Algorithm,
    CounterfactualRecipe,
    ModesPlan,
    NetworkShape,
    OptionsRecipe,
    PpoRecipe,
    SacRecipe,
    Training,
)
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats, Ints, Packed, Worlds, columns, compiled, exp, log
from ethbrake_marl.policies import Activation, Actor, Float32s, Layers, NetworkSpec, Policy, load_named_policy
from ethbrake_marl.search import best_templates, profile_problem

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


def tensors_of(policy: BasePolicy, spec: NetworkSpec) -> dict[str, Float32s]:
    """Copy the policy's weights under the names of our table."""
    state = policy.state_dict()
    return {row.name: state[row.sb3_name].detach().cpu().numpy().astype(np.float32) for row in spec.tensors}


class Ppo(Algorithm):
    """Stable-Baselines3's PPO: one for all learners, with a central critic, or one for each."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> PPO:
        """The model of the training's scheme."""
        recipe = training.recipe
        assert isinstance(recipe, PpoRecipe)
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
        if training.scheme == "independent":
            return IndependentPPO(environment, list(training.drivers), recipe.turns, training.columns, **settings)
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
    """An actor, a critic and an optimiser for each learner; a row's last number says which of them sees the row.

    Of the rest of it, it sees its own ``columns``. ``resting`` learners do not explore: they act by their mean.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        lr_schedule: Schedule,
        use_sde: bool = False,
        *,
        columns: Sequence[Sequence[int]],
        **network: Any,
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        low, high, kind = observation_space.low, observation_space.high, observation_space.dtype.type
        own = [Box(low[list(each)], high[list(each)], dtype=kind) for each in columns]
        self.columns = columns
        self.members = nn.ModuleList(
            ActorCriticPolicy(space, action_space, lr_schedule, use_sde=use_sde, **network) for space in own
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
            actions[rows], values[rows], likelihood[rows] = policy(observation[rows][:, self.columns[number]], still)
        return actions, values, likelihood

    def predict_values(self, observation: Any) -> Tensor:
        """Values [n, 1] of rows [n, F + 1]."""
        values = torch.empty(len(observation), 1)
        for number, policy, rows in self._by_learner(observation):
            values[rows] = policy.predict_values(observation[rows][:, self.columns[number]])
        return values

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
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

    def __init__(
        self, env: VecEnv, names: Sequence[str], turns: int | None, columns: Sequence[Sequence[int]], **settings: Any
    ) -> None:
        self.names, self.turns = tuple(names), turns
        arguments = {**settings.pop("policy_kwargs"), "columns": columns}
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
        part.observations = buffer.observations[:, number::count][:, :, self.policy.columns[number]]
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
            policy_kwargs=sac_arguments(recipe),
            seed=recipe.seed,
            device="cpu",
        )

    def optimizers(self, model: Any) -> dict[str, Optimizer]:
        """Those of actor and critics, and of the entropy coefficient where it is learned."""
        found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
        return found if model.ent_coef_optimizer is None else {**found, "ent_coef": model.ent_coef_optimizer}

    def learned_beside(self, model: Any) -> dict[str, Tensor]:
        """The logarithm of the entropy coefficient, where it is learned."""
        coefficient = self.log_noise(model)
        return {} if coefficient is None else {"log_ent_coef": coefficient}

    def log_noise(self, model: Any) -> Tensor | None:
        """The logarithm of the entropy coefficient; None where it is fixed."""
        return None if model.log_ent_coef is None else model.log_ent_coef.detach()


def sac_arguments(recipe: SacRecipe) -> dict[str, Any]:
    """Arguments of SAC's policy: an actor and two critics."""
    shape = recipe.network
    return {
        "net_arch": {"pi": list(shape.policy), "qf": list(shape.value)},
        "activation_fn": ACTIVATIONS[shape.activation],
    }


# Branches of running episodes: the same moment, played on to the end in more than one way.
#
# A learner's action is moved by an offset for a few steps; then the policy goes on in closed loop. What two branches
# gain differs by nothing but the offset: everything else in them is the same, to the bit.

ROUNDING_MPS2 = 1e-5  # a command that differs by less is the same: networks round by the size of their batch

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]

Decide = Callable[[Observations, Ints, int], Floats]  # what is seen [m, L, F] in rows [m], steps made -> actions [m, L]


class Offsets(NamedTuple):
    """How one learner's actions in each row differ from those of its policy."""

    learner: Ints  # [n] place among the learners
    size: Floats  # [n] added to its action, which stays in [-1, 1]
    steps: Ints  # [n] for so many steps, at least 1


def play_to_the_end(engine: Engine, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Play every row to the end of its episode; what its learner of ``offsets`` gains, and how far it was moved.

    Args:
        engine: branches, which this changes.
        act: drives all learners, by nothing but what is seen.
        offsets: whose actions are moved in each row, how far, and how long.
        gamma: discount of one time step.

    Returns the return [n] of that learner from now on (NaN for a row that could not be advanced), and the sum of the
    offsets that its actions, which stay in [-1, 1], had room for [n]. Where the reward is of harm alone, a row ends as
    soon as nothing can change any more.

    """
    moved, most = np.zeros(engine.n), int(offsets.steps.max(initial=0))

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        wanted = act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])
        some = np.flatnonzero(number < offsets.steps[rows])  # whose offset still lasts
        lasting = rows[some]
        before = wanted[some, offsets.learner[lasting]]
        after = np.clip(before + offsets.size[lasting], -1.0, 1.0)
        wanted[some, offsets.learner[lasting]] = after
        moved[lasting] += after - before
        return wanted

    gained = play_on(engine, decide, gamma, at_least=most)
    return gained[np.arange(engine.n), offsets.learner], moved


def play_on(engine: Engine, decide: Decide, gamma: float, *, at_least: int = 0) -> Floats:
    """Play every row to the end of its episode, ``at_least`` so many steps; what each learner gains, [n, L].

    ``decide`` gives the learners' actions. The rest is as for ``play_to_the_end``.
    """
    vehicles = np.array(engine.learners, np.int64)
    gained, actions = np.zeros((engine.n, len(vehicles))), np.zeros((engine.n, len(vehicles)))
    running, discount, number = np.flatnonzero(~engine.ended), 1.0, 0
    only_harm = set(engine.reward_terms) <= {"harm"}
    while len(running):
        before = engine.packed.state.take(running, axis=0)
        actions[running] = decide(engine.observe_all(vehicles, running), running, number)
        step = engine.step(actions)
        gained[running] += discount * step.reward[running][:, vehicles]
        goes_on = ~engine.ended[running]
        if only_harm and number >= at_least:
            goes_on &= ~_stands_for_good(engine, before, running)
        running = running[goes_on]
        discount *= gamma
        number += 1
    gained[list(engine.roster.failed)] = np.nan
    return gained


def visit(engine: Engine, act: Act) -> tuple[Observations, Moment]:
    """Play every row to its end by ``act``: what is seen at each decision [m, L, F], and those moments [m]."""
    seen_then, moments = [], []

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        seen_then.append(seen)
        moments.append(engine.moment().take(rows))
        return act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])

    play_on(engine, decide, 1.0)
    return np.concatenate(seen_then), Moment.join(moments)


def _stands_for_good(engine: Engine, before: Floats, rows: Ints) -> Bools:
    """In which of ``rows`` everything stands as it stood ``before`` [rows], and the same is going to be done again.

    A policy that sees the same does the same, and no latency or news is left that could change what it sees.
    """
    if engine.packed.has_messages or engine.in_pieces:
        return np.zeros(len(rows), np.bool_)  # what is still on its way may change what it sees, or what holds
    (state, params), stands = engine.packed, np.empty(len(rows), np.bool_)
    find_standing(state, before, params, rows, stands)
    return stands


@compiled
def find_standing(state: Floats, before: Floats, params: Floats, rows: Ints, stands: Bools) -> None:
    """Fill ``stands`` [m] for ``rows`` [m] of ``state``, which stood as ``before`` [m]."""
    column = columns(state)
    by_link = params.shape[1] > column.own_latency
    for m in range(rows.shape[0]):
        k, same = rows[m], True
        for c in range(column.speed, column.command):
            same = same and before[m, c] == 0.0 and state[k, c] == 0.0
        if same:
            for c in range(column.gap, column.harm):
                same = same and state[k, c] == before[m, c]
            for c in range(column.command, column.previous):
                same = same and abs(state[k, c] - before[m, c]) < ROUNDING_MPS2
            for c in range(column.latency, params.shape[1]):
                known = column.latency <= c < column.mass or (by_link and c >= column.news)
                same = same and (not known or params[k, c] < before[m, column.time] or np.isinf(params[k, c]))
        stands[m] = same


# Learning from exact counterfactuals: one actor, or several networks and a gate between them.
#
# The actor drives without exploration; some of its decisions are tried with a little more and a little less, each
# played on to the end of its episode, and the actor is regressed on what was better.


class Counterfactual(Algorithm):
    """Gradients of the return by playing on from the same moment in two ways; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> CounterfactualModel:
        """The model, from the policy of the training's ``start`` if it has one."""
        recipe = training.recipe
        assert isinstance(recipe, CounterfactualRecipe)
        environment.engine.branch(environment.engine.moment())  # refuses what cannot be branched before it begins
        model = (CounterfactualModel if recipe.modes is None else ModesModel)(environment, recipe)
        if training.start is not None:
            kind, _, path = training.start.partition("@")
            policy = load_named_policy(path, kind, training.scenario, recipe.reward.harm_count)
            first = model.policy.actors[0] if isinstance(model, ModesModel) else model.policy
            first.take_over(widened(policy, training))
        return model

    def optimizers(self, model: BaseAlgorithm) -> dict[str, Optimizer]:
        """The optimiser of the actor, or that of each network and of the gate."""
        if not isinstance(model, ModesModel):
            return {"policy": model.policy.optimizer}
        members = {f"network_{k + 1}": actor.optimizer for k, actor in enumerate(model.policy.actors)}
        return {**members, "gate": model.policy.gate.optimizer}


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """The actor's tensors of ``policy`` for what the training observes; features that are new to it count for nothing.

    Raises ``InvalidInput`` where the training does not observe all that the policy does, or has another network.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    found = policy.manifest.network
    if found.networks > 1:
        raise InvalidInput(f"recipe {recipe.name!r}: start: has {found.networks} networks; give a policy of one")
    for name in ("policy_hidden", "activation", "output"):
        if getattr(found, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network: {name} is {getattr(wanted, name)}, but {getattr(found, name)} in the"
                " policy to start from; they must be the same"
            )
    return padded(policy, training, "start")


def padded(policy: Policy, training: Training, key: str) -> dict[str, NDArray[np.float32]]:
    """All tensors of ``policy`` but a critic's, for what the training observes; features new to it count for nothing.

    Raises ``InvalidInput``, naming the recipe's ``key``, where the training does not observe all that the policy does.
    """
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {training.recipe.name!r}: observation: lacks {', '.join(missing[:5])}, which the policy of {key}"
            " observes; list what it observes, and more"
        )
    found = {name: tensor.copy() for name, tensor in policy.tensors.items() if not name.startswith("value.")}
    for name in [name for name in found if name.endswith(".0.weight")]:
        first = np.zeros((len(found[name]), len(names)), np.float32)
        first[:, [names.index(feature) for feature in known]] = found[name]
        found[name] = first
    return found


class Adam(torch.optim.Adam):
    """torch's, to the bit, without what imports torch's compiler (1 to 3 CPU-s), which has nothing to do here."""


for _name in ("step", "add_param_group", "zero_grad", "state_dict", "load_state_dict"):
    setattr(Adam, _name, torch.no_grad()(inspect.unwrap(getattr(torch.optim.Adam, _name))))


def adam(rate: float, *networks: nn.Module | None) -> Adam:
    """An optimiser of all weights of these networks."""
    return Adam([weight for each in networks if each is not None for weight in each.parameters()], lr=rate, eps=1e-5)


def descend(optimizer: Optimizer, *losses: Tensor) -> None:
    """One step down the sum of these losses."""
    optimizer.zero_grad()
    for loss in losses:
        loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@torch.no_grad()
def follow(average: Iterable[Tensor], learning: nn.Module, keep: float) -> None:
    """Move an average of weights towards the weights that learn, keeping this share of what it was."""
    for mean, learns in zip(average, learning.parameters(), strict=True):
        mean.lerp_(learns, 1.0 - keep)


class _Deterministic(BasePolicy):
    """A policy whose actions are its ``means``, cut at -1 and 1."""

    def means(self, observation: Float32s) -> Float32s:
        """What the weights that learn say to observations [rows, F], [rows]; beyond -1 and 1 it means -1 and 1."""
        raise NotImplementedError

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that is to be expected, [rows]."""
        raise NotImplementedError

    def act(self, observation: Float32s) -> Float32s:
        """Its actions [rows] in [-1, 1]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        found: Tensor = self.forward(observation)
        return found


class AveragedActor(_Deterministic):
    """An actor that learns (``learning``), and the running average of its weights, which drives.

    The average stands under the names of Stable-Baselines3's PPO, as a bundle wants it.
    """

    def __init__(
        self, observation_space: Space[Any], action_space: Any, rate: Schedule, recipe: CounterfactualRecipe
    ) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape = flatdim(observation_space), recipe.network
        hidden, activation = list(shape.policy), ACTIVATIONS[shape.activation]
        self.mlp_extractor = nn.ModuleDict({"policy_net": nn.Sequential(*create_mlp(inputs, -1, hidden, activation))})
        self.action_net = nn.Linear(hidden[-1], 1)
        for layer in self.mlp_extractor.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
                nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.action_net.weight, 0.01)
        nn.init.constant_(self.action_net.bias, shape.initial_action or 0.0)
        # of the bundle: the actor itself never explores
        self.log_std = nn.Parameter(torch.full((1,), -3.0), requires_grad=False)
        last = nn.Linear(hidden[-1], 1)
        self.learning = nn.Sequential(*create_mlp(inputs, -1, hidden, activation), last)
        self.average = [*self.mlp_extractor.parameters(), *self.action_net.parameters()]
        self._spec = shape.spec(inputs)
        self._learn_from_average()
        self.scout = Scout(inputs) if recipe.focus > 0.0 else None
        self.optimizer = adam(rate(1.0), self.learning, self.scout)

    @torch.no_grad()
    def _learn_from_average(self) -> None:
        for mean, learns in zip(self.average, self.learning.parameters(), strict=True):
            learns.copy_(mean)

    def take_over(self, tensors: Mapping[str, Float32s]) -> None:
        """Begin with these tensors of a bundle."""
        state = self.state_dict()
        for row in self._spec.tensors:
            state[row.sb3_name].copy_(torch.from_numpy(tensors[row.name]))
        self._learn_from_average()

    @torch.no_grad()
    def means(self, observation: Float32s) -> Float32s:
        found: Float32s = self.learning(torch.from_numpy(observation))[:, 0].numpy()
        return found

    def expect(self, observation: Float32s) -> Floats:
        assert self.scout is not None
        return self.scout.expect(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        means: Tensor = self.action_net(self.mlp_extractor["policy_net"](observation))
        return means.clamp(-1.0, 1.0)


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and what that brought."""

    seen: Float32s  # [B, F]
    mean: Float32s  # [B] what the actor said; beyond -1 and 1 it means -1 and 1
    gradient: Float32s  # [B] of the return by the action
    importance: Float32s  # [B] what each counts


class CounterfactualModel(BaseAlgorithm):
    """Visits decisions by its deterministic actor, tries some of them in two ways, and learns from the difference."""

    policy: AveragedActor

    def __init__(self, environment: EthBrakeVecEnv, recipe: CounterfactualRecipe) -> None:
        super().__init__(
            AveragedActor,
            environment,
            stats_window_size=max(100, environment.num_envs),
            device="cpu",
            support_multi_env=True,
            learning_rate=recipe.learning_rate.at,
            seed=recipe.seed,
        )
        self.recipe, self.rows, self.engine = recipe, environment, environment.engine
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        kind: Any = AveragedActor if self.recipe.modes is None else ModesPolicy
        self.policy = kind(self.observation_space, self.action_space, self.lr_schedule, self.recipe)
        if self.recipe.gradient_limit == "auto":  # a checkpoint keeps it with the policy's weights
            self.policy.register_buffer("measured", torch.zeros(REMEMBERED, 2, dtype=torch.float64))

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "counterfactual",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for so many decisions of learners."""
        total, told = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        told.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            told.on_rollout_start()
            self._update(told, total)
        told.on_training_end()
        return self

    def _update(self, told: BaseCallback, total: int) -> None:
        """One round of collecting and learning."""
        actor = self.policy
        seen, moments = self._visit(told, actor.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._train(actor, self._try_out(seen, moments, actor))

    def _visit(self, told: BaseCallback, act: Act) -> tuple[Float32s, Moment]:
        """Drive on for ``n_steps``; what was seen [n_steps, rows, F], and the worlds' moments, step by step."""
        seen, moments, numbers = [], [], []
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            seen.append(observations)
            numbers.append(self.engine.roster.numbers.copy())
            moments.append(self.engine.moment())
            new_obs, rewards, dones, infos = self.rows.step(act(observations)[:, np.newaxis])
            self.num_timesteps += self.n_envs
            self._update_info_buffer([infos[row] for row in np.flatnonzero(dones)], dones[dones])  # others tell nothing
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            told.update_locals(locals())
            told.on_step()
        self._numbers = np.concatenate(numbers)  # of those worlds in the training
        return np.stack(seen), Moment.join(moments)

    def _try_out(self, seen: Float32s, moments: Moment, actor: _Deterministic) -> Tried:
        """Try some of the visited decisions with more and with less, each to the end of its episode."""
        recipe, learners = self.recipe, len(self.engine.learners)
        moving = np.flatnonzero(moving_rows(moments).repeat(learners))
        observed = seen.reshape(-1, seen.shape[2])
        rows, importance = choose_rows(observed, moving, recipe.counterfactuals, recipe.focus, actor.expect)
        least, most = recipe.offset.smallest, recipe.offset.largest
        memory: Tensor | None = getattr(self.policy, "measured", None)  # where the limit is auto
        if memory is not None:
            least = smallest_offset(memory.numpy(), least, most)
        sizes: Floats = least * (most / least) ** torch.rand(len(rows), dtype=torch.float64).numpy()
        holds = np.array(recipe.holds, np.int64)[torch.randint(len(recipe.holds), (len(rows),)).numpy()]
        worlds: Ints = np.tile(rows // learners, 2)
        engine = self.engine.branch(moments.take(worlds))
        offsets = Offsets(np.tile(rows % learners, 2), np.concatenate([sizes, -sizes]), np.tile(holds, 2))
        gained, moved = (np.split(each, 2) for each in play_to_the_end(engine, actor.act, offsets, recipe.gamma))
        measured = (gained[0] - gained[1]) / (moved[0] - moved[1])
        good = np.isfinite(measured)
        limit = recipe.gradient_limit
        if memory is not None:
            new = torch.from_numpy(np.stack([np.abs(measured[good]), sizes[good]], axis=1))
            memory.copy_(torch.cat([memory, new])[-len(memory) :])
            limit = limit_that_cuts(memory[:, 0].numpy(), CUT)
            self.logger.record("train/gradient_limit", limit)
            self.logger.record("train/smallest_offset", least)
        assert limit != "auto"
        gradient = np.clip(measured, -limit, limit)
        whole = float(np.abs(measured[good]).sum())
        self.logger.record("train/gradient_cut", 1.0 - float(np.abs(gradient[good]).sum()) / whole if whole else 0.0)
        then = observed[rows[good]]
        return Tried(then, actor.means(then), gradient[good].astype(np.float32), importance[good])

    def _train(self, actor: AveragedActor, tried: Tried) -> None:
        """Regress the actor on actions that are better, within the trust radius; log what that was."""
        recipe = self.recipe
        self._update_learning_rate(actor.optimizer)
        target, weight = trusted_targets(tried, recipe.trust_radius, recipe.anchor)
        arrays = (tried.seen, target, weight * tried.importance, np.abs(tried.gradient), tried.importance)
        seen, wanted, weights, sizes, importance = (torch.from_numpy(array) for array in arrays)
        losses = []
        for _ in range(recipe.n_epochs):
            for batch in torch.split(torch.randperm(len(wanted)), recipe.batch_size):
                means = actor.learning(seen[batch])[:, 0]
                loss = (weights[batch] * (means - wanted[batch]) ** 2).mean()
                found = [loss]
                if actor.scout is not None:
                    found.append(actor.scout.loss(seen[batch], sizes[batch], importance[batch]))
                descend(actor.optimizer, *found)
                follow(actor.average, actor.learning, recipe.averaging)
                losses.append(loss.item())
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(np.abs(tried.gradient).mean()) if len(wanted) else 0.0)
        self.logger.record("train/counterfactuals", len(wanted))


# ``gradient_limit: auto``: limit and smallest offset follow the gradients that were measured last.

REMEMBERED = 65_536  # measured gradients
CUT = 0.1  # share of the sum of their sizes that the limit cuts
SPREAD = 2.0  # at the smallest offset the spread of gradients is at most so many times that at the largest
NARROWEST = 4.0  # but offsets are drawn from a range at least so wide


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """The limit at which cutting takes this share of the sum of these sizes [n]."""
    rising = np.sort(sizes)
    kept = np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising  # of the sum, by each of them as the limit
    return float(np.interp((1.0 - share) * kept[-1], kept, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """The smallest offset to draw: ``least``, or more where the spread of gradients falls steeply with the offset.

    A jump of the harm makes the spread fall as the root of the offset, a smooth harm leaves it as it is. The slope is
    that between the smaller and the larger half of the offsets of ``measured`` [n, 2], sizes and offsets (0: none yet).
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))


def other_count(count: HarmCount) -> HarmCount:
    """Of both, the one that it is not."""
    return "total" if count == "first" else "first"


def moving_rows(moments: Moment) -> Bools:
    """In which rows some vehicle moves; where everything stands there is nothing to learn."""
    column = Packed(moments.state, moments.params).column
    moving: Bools = (moments.state[:, column.speed : column.command] != 0.0).any(axis=1)
    return moving


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Where the means [B] should go, and how much that weighs [B]: ``m + g / w`` with ``w = |g| / radius + anchor``.

    Half the weighted squared distance from there is, up to a constant, ``-g (mu - m) + w (mu - m)^2 / 2``: the exact
    slope, and a curvature with which nothing moves farther than the radius, however large its gradient. A mean at or
    beyond a bound is not asked to go farther out, where its action would not change.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight


# A scout: it learns at which decisions a difference is to be expected, so that most are tried where there is one.
#
# Where nothing depends on what is done, a counterfactual says 0 and costs as much as any other. Decisions are drawn
# with unequal chances, and each counts the less, the likelier it was drawn: what is learned is the same on average.

WIDTH = 64  # of its hidden layer


class Scout(nn.Module):
    """A small network for the size of the difference that is to be expected of an observation."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # until it learns, it expects the same everywhere
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """The logarithm of what is to be expected [rows] of observations [rows, F]; at most 20."""
        found: Tensor = self.layers(observation)[:, 0].clamp(max=20.0)
        return found

    def expect(self, observation: Float32s) -> Floats:
        """What is to be expected [rows], above 0."""
        with torch.no_grad():
            found: Floats = np.exp(self(torch.from_numpy(observation)).numpy().astype(np.float64))
        return found

    def loss(self, observation: Tensor, size: Tensor, importance: Tensor) -> Tensor:
        """Least where it expects the mean size; of sizes [rows] >= 0, whose largest do not rule it as in a square."""
        logarithm = self(observation)
        found: Tensor = (importance * (logarithm.exp() - size * logarithm)).mean()
        return found


def draw_rows(expected: Floats, count: int, focus: float) -> tuple[Ints, Float32s]:
    """Draw ``count`` of the rows: the share ``focus`` in proportion to ``expected`` [n] > 0, the others evenly.

    A row stands several times where a difference is expected. Each counts 1 / (chance of the row x number of rows),
    whose mean is 1 on average.
    """
    n = len(expected)
    chance = (1.0 - focus) / n + focus * (expected / expected.sum())
    rows = torch.multinomial(torch.from_numpy(chance), count, replacement=True).numpy()
    return rows, (1.0 / (n * chance[rows])).astype(np.float32)


def choose_rows(
    observed: Float32s, rows: Ints, count: int, focus: float, expect: Callable[[Float32s], Floats] | None
) -> tuple[Ints, Float32s]:
    """Draw ``count`` of ``rows``: evenly and each once, or mostly where ``expect`` says that there is a difference."""
    if focus == 0.0 or expect is None or len(rows) == 0:
        some = rows[torch.randperm(len(rows))[:count].numpy()]
        return some, np.ones(len(some), np.float32)
    drawn, importance = draw_rows(expect(observed[rows]), count, focus)
    return rows[drawn], importance


# Options: several actions are tried at a decision, and the actor learns to choose the one that costs least.

FOR_GOOD = 2**31  # steps: more than any episode has
USUAL_KEPT = 0.98  # share of itself that the running mean of costs keeps in each update
LEAST_USUAL = 0.1  # m2/s2: a scenario with next to no harm counts no more than one with so much


class Options(Algorithm):
    """Policy iteration by what actions cost in closed loop; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> OptionsModel:
        """The model, from random weights and full braking."""
        recipe = training.recipe
        assert isinstance(recipe, OptionsRecipe)
        environment.engine.branch(environment.engine.moment())  # refuses what cannot be branched before it begins
        among = [padded(policy, training, "among") for policy in recipe.policies]
        return OptionsModel(environment, recipe, among)


class _TorchActor(Actor):
    """The actor of a bundle, three times as fast, to other last bits."""

    @torch.no_grad()
    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        activation = torch.relu if self.spec.activation == "relu" else torch.tanh
        y: Tensor = torch.from_numpy(x)
        for number, (weight, bias) in enumerate(layers, start=1):
            y = torch.addmm(torch.from_numpy(bias)[:, None], torch.from_numpy(weight), y)
            y = y if number == len(layers) else activation(y)
        found: Float32s = y.numpy()
        return found


class ChoosingActor(_Deterministic):
    """An actor that scores actions (``learning``), the average of its weights (``average``), which drives, and what it
    remembers: the last decisions at which actions were tried, and how much more than the best one each of them costs.
    """

    seen: Tensor  # [M, F]
    tried: Tensor  # [M, C] numbers of actions, the one that was taken first
    more: Tensor  # [M, C]
    known: Tensor  # [1] decisions so far; the newest take the places of the oldest
    usual: Tensor  # [members] what the best action tried costs on average in each scenario of a mixture; 0: not known

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        rate: Schedule,
        recipe: OptionsRecipe,
        among: Sequence[Mapping[str, Float32s]],
        members: int,
    ) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape, room = flatdim(observation_space), recipe.network, (recipe.memory, 1 + recipe.others)
        self.first, scores = len(among), len(among) + shape.choices  # the number of the first action behind policies
        layers = create_mlp(inputs, scores, list(shape.policy), ACTIVATIONS[shape.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, it takes the first: a policy's
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]  # action, or full braking
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.optimizer = adam(rate(1.0), self.learning)
        spec = recipe.network_spec(inputs)
        tensors = {f"among_{m}.{name}": each[name] for m, each in enumerate(among, 1) for name in each}
        for name, tensor in tensors.items():
            self.register_buffer(name.replace(".", "_"), torch.from_numpy(tensor))
        chooser = {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors if row.name not in tensors}
        self.take = _TorchActor(spec, {**chooser, **tensors}).take
        self.register_buffer("usual", torch.zeros(members, dtype=torch.float64))
        self.register_buffer("seen", torch.zeros(recipe.memory, inputs))
        self.register_buffer("tried", torch.zeros(room, dtype=torch.int64))
        self.register_buffer("more", torch.zeros(room))
        self.register_buffer("known", torch.zeros(1, dtype=torch.int64))

    @torch.no_grad()
    def choose(self, observation: Float32s) -> Ints:
        """Numbers of its actions [rows] for observations [rows, F]."""
        chosen: Ints = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen

    def act(self, observation: Float32s) -> Float32s:
        found: Float32s = self.take(self.choose(observation), observation.T)[0]
        return found

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        return torch.from_numpy(self.act(observation.numpy()))[:, None]

    def remember(self, seen: Float32s, tried: Ints, more: Floats) -> None:
        """Keep decisions."""
        places = torch.arange(int(self.known), int(self.known) + len(seen)) % len(self.seen)
        self.seen[places], self.tried[places] = torch.from_numpy(seen), torch.from_numpy(tried)
        self.more[places] = torch.from_numpy(more.astype(np.float32))
        self.known += len(seen)

    def draw(self, batches: int, count: int, focus: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Some of the kept decisions for each step, and what each of them counts; ``focus`` as for ``draw_rows``."""
        known = min(int(self.known), len(self.seen))
        if focus == 0.0 or batches == 0:
            for _ in range(batches):
                yield torch.randint(known, (count,)), torch.ones(count)
            return
        rows, importance = draw_rows(self.more[:known].max(dim=1).values.numpy(), batches * count, focus)
        for start in range(0, len(rows), count):
            part = slice(start, start + count)
            yield torch.from_numpy(rows[part]), torch.from_numpy(importance[part])

    def loss(self, some: Tensor, importance: Tensor, guide: float) -> Tensor:
        """Of some of the kept decisions: the expected cost of choosing with the chances of a softmax of the scores.

        Where the chances are nearly 0 or 1 this has no slope. So ``guide`` times a convex loss is added: each action
        that is not the best should have a lower score, the more so the more it costs.
        """
        more = self.more[some]
        scores = self.learning(self.seen[some]).gather(1, self.tried[some])
        best = scores.gather(1, more.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * more).sum(dim=1)
        found: Tensor = (importance * (expected + guide * (more * softplus(scores - best)).sum(dim=1))).mean()
        return found


class OptionsModel(CounterfactualModel):
    """Visits decisions by its actor, tries several actions at some of them, and learns what each costs."""

    policy: ChoosingActor  # type: ignore[assignment]
    recipe: OptionsRecipe  # type: ignore[assignment]

    def __init__(
        self, environment: EthBrakeVecEnv, recipe: OptionsRecipe, among: Sequence[Mapping[str, Float32s]]
    ) -> None:
        self._among = among
        super().__init__(environment, recipe)  # type: ignore[arg-type]  # it has what all models ask for

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        members = len(self.engine.scenario.members) or 1
        self.policy = ChoosingActor(
            self.observation_space, self.action_space, self.lr_schedule, self.recipe, self._among, members
        )

    def _update(self, told: BaseCallback, total: int) -> None:
        recipe, actor = self.recipe, self.policy
        seen, moments = self._visit(told, actor.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._update_learning_rate(actor.optimizer)
        observed, tried, costs = self._try_actions(seen, moments)
        more = costs - costs.min(axis=1, keepdims=True)
        telling = np.flatnonzero(more.max(axis=1) > 1e-9)
        more = np.minimum(more, recipe.largest_cost)
        actor.remember(observed[telling], tried[telling], more[telling])
        self.logger.record("train/regret", float(more[:, 0].mean()) if len(more) else 0.0)
        self.logger.record("train/telling", len(telling))
        losses = []
        steps = recipe.gradient_steps if int(actor.known) else 0
        for some, importance in actor.draw(steps, recipe.batch_size, recipe.focus):
            loss = actor.loss(some, importance, recipe.guide)
            descend(actor.optimizer, loss)
            follow(actor.average.parameters(), actor.learning, recipe.averaging)
            losses.append(loss.item())
        self._n_updates += len(losses)
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)

    def _try_actions(self, seen: Float32s, moments: Moment) -> tuple[Float32s, Ints, Floats]:
        """At some decisions: what is seen [B, F], numbers of the actions tried [B, C], and what each costs [B, C].

        The first one is the one that the actor takes. ``caution`` is part of the costs.
        """
        recipe, actor, learners = self.recipe, self.policy, len(self.engine.learners)
        observed, first, last = seen.reshape(-1, seen.shape[2]), actor.first, recipe.network.choices - 1
        moving = np.flatnonzero(moving_rows(moments).repeat(learners))
        rows = moving[torch.randperm(len(moving))[: recipe.tried].numpy()]
        taken = actor.choose(observed[rows])
        at = np.rint((actor.take(taken, observed[rows].T)[0] + 1.0) * last / 2.0).astype(np.int64)
        numbers = [taken]
        for near in recipe.near:
            ratio = (near.largest / near.smallest) ** torch.rand(len(rows), dtype=torch.float64).numpy()
            far = np.maximum(np.rint(near.smallest * ratio * last / 2.0).astype(np.int64), 1)
            numbers += [first + np.clip(at - far, 0, last), first + np.clip(at + far, 0, last)]
        numbers += [np.full(len(rows), first + round((action + 1.0) * last / 2.0)) for action in recipe.fixed]
        if first:
            numbers += [*torch.rand(len(rows), first).argsort(dim=1)[:, : recipe.drawn].T.numpy()]
        else:
            numbers += [torch.randint(last + 1, (len(rows),)).numpy() for _ in range(recipe.drawn)]
        tried, every = np.stack(numbers, axis=1), first + last + 1
        holds = np.array(recipe.holds, np.int64)[torch.randint(len(recipe.holds), (len(rows),)).numpy()]
        each, back = np.unique(np.arange(len(rows))[:, None] * every + tried, return_inverse=True)
        row, number = each // every, each % every
        steps = holds[row]
        if recipe.caution:  # one more branch of each decision brakes fully from there to the end
            row, number = np.append(row, np.arange(len(rows))), np.append(number, np.full(len(rows), first))
            steps = np.append(steps, np.full(len(rows), FOR_GOOD))
        learner = rows[row] % learners

        def decide(now: Observations, some: Ints, done: int) -> Floats:
            flat, held = now.reshape(-1, now.shape[2]), np.flatnonzero(done < steps[some])
            chosen = np.full(len(flat), -1)
            chosen[held * learners + learner[some[held]]] = number[some[held]]
            free = np.flatnonzero(chosen < 0)
            chosen[free] = actor.choose(flat[free])
            wanted: Floats = actor.take(chosen, flat.T)[0].astype(np.float64)
            return wanted.reshape(now.shape[:2])

        engine = self.engine.branch(moments.take(rows[row] // learners))
        other = other_count(engine.reward.harm_count)
        before = engine.ledger.world_harm(other)
        gained = play_on(engine, decide, recipe.gamma, at_least=max(recipe.holds))
        found = -gained[np.arange(len(row)), learner]
        if recipe.tie_break:
            found += recipe.tie_break * (engine.ledger.world_harm(other) - before)
        costs = found[back].reshape(tried.shape)
        if recipe.caution:
            done = 1.0 - self._current_progress_remaining
            costs += recipe.caution * done * np.maximum(costs - found[len(each) :, np.newaxis], 0.0)
        good = np.isfinite(costs).all(axis=1)
        rows, tried, costs = rows[good], tried[good], costs[good]
        if recipe.relative and len(rows):
            costs /= self._usual(rows // learners, costs.min(axis=1))[:, np.newaxis]
        return observed[rows], tried, costs

    def _usual(self, rows: Ints, least: Floats) -> Floats:
        """What decisions [B] of these rows usually cost in their scenarios [B], to which these costs are added."""
        numbers = self._numbers[rows]
        first = int(numbers.min())
        drawn = self.engine.scenario.members_of(
            int(numbers.max()) - first + 1, self.engine.seed, first=first, channel="training"
        )
        member, usual = drawn[numbers - first], self.policy.usual.numpy()
        for m in np.unique(member):
            mean = float(least[member == m].mean())
            usual[m] = USUAL_KEPT * usual[m] + (1.0 - USUAL_KEPT) * mean if usual[m] else mean
        found: Floats = np.maximum(usual[member], LEAST_USUAL)
        return found


# Several networks: which updates of a training do what.

ROUNDING = 1e-6  # of sums of shares, in updates


class Stage(NamedTuple):
    """What a stretch of updates is for."""

    does: Literal["alone", "further", "gate", "together"]
    network: int  # that of ``further``
    first: int  # update, from 0
    end: int  # the first update after it


def stages_of(plan: ModesPlan, updates: int) -> tuple[Stage, ...]:
    """The stages of a training with so many updates, in order; some may be empty."""
    shares, more = plan.shares, plan.networks - 1
    parts: list[tuple[Literal["alone", "further", "gate", "together"], int, float]] = [("alone", 0, shares.alone)]
    parts += [("further", k + 1, shares.further / more) for k in range(more)]
    parts += [("gate", 0, shares.gate), ("together", 0, shares.together)]
    found, done, first = [], 0.0, 0
    for does, network, share in parts:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        found.append(Stage(does, network, first, end))
        first = end
    return tuple(found)


# The gate between several networks: what it has learned, the average that decides, and what it remembers.


class AveragedGate(nn.Module):
    """A gate that learns (``learning``), and the running average of its weights (``average``), which decides.

    It remembers the last decisions at which networks were compared: what was seen, and how much more than the best one
    each of them costs.
    """

    seen: Tensor  # [M, F]
    more: Tensor  # [M, K]
    compared: Tensor  # [1] so far; the newest take the places of the oldest

    def __init__(self, inputs: int, rate: Schedule, recipe: CounterfactualRecipe) -> None:
        super().__init__()
        plan = recipe.modes
        assert plan is not None
        layers = create_mlp(inputs, plan.networks, list(plan.gate), ACTIVATIONS[recipe.network.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, the first network acts
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.scout = Scout(inputs) if recipe.focus > 0.0 else None
        self.optimizer = adam(rate(1.0), self.learning, self.scout)
        self.register_buffer("seen", torch.zeros(plan.gate_memory, inputs))
        self.register_buffer("more", torch.zeros(plan.gate_memory, plan.networks))
        self.register_buffer("compared", torch.zeros(1, dtype=torch.int64))

    def remember(self, seen: Float32s, more: Float32s) -> None:
        """Keep compared decisions."""
        places = torch.arange(int(self.compared), int(self.compared) + len(seen)) % len(self.seen)
        self.seen[places], self.more[places] = torch.from_numpy(seen), torch.from_numpy(more)
        self.compared += len(seen)

    def recall(self, count: int) -> tuple[Tensor, Tensor]:
        """Some of the kept ones, [count, F] and [count, K]."""
        some = torch.randint(min(int(self.compared), len(self.seen)), (count,))
        return self.seen[some], self.more[some]

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Which network acts on each of the observations [rows, F], [rows]."""
        with torch.no_grad():
            chosen: NDArray[np.int64] = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen


# The worlds of another mode: where random templates of a whole episode do better than every network so far.

NO_DIFFERENCE = 1e-2  # of returns: two networks that differ by less do the same


class Explored(NamedTuple):
    """Worlds of the training, and the best that networks do in them."""

    alert: Worlds
    start: Moment  # at the first decision
    gained: Floats  # [n] the highest return
    harm: Floats  # [n] the least harm (m2/s2)


class Shown(NamedTuple):
    """What templates did at each decision, to be imitated."""

    seen: Float32s  # [m, F]
    action: Float32s  # [m]


def explore(engine: Engine, plan: ModesPlan, acts: Sequence[Act], gamma: float) -> Explored:
    """The first worlds of the training, each driven by every network from its start to its end."""
    alert, start = engine.first_moments(plan.worlds)
    gained, harm = np.full(plan.worlds, -np.inf), np.full(plan.worlds, np.inf)
    for act in acts:
        its_gain, its_harm = drive_from(engine, start, act, gamma)
        gained, harm = np.fmax(gained, its_gain), np.fmin(harm, its_harm)
    return Explored(alert, start, gained, harm)


def drive_from(
    engine: Engine, start: Moment, act: Act, gamma: float, count: HarmCount | None = None
) -> tuple[Floats, Floats]:
    """Return of the first learner [n], NaN for a row that could not be advanced, and harm of the world [n] (m2/s2).

    The harm is of the reward's count unless another one is given.
    """
    rows = engine.branch(start)
    nowhere = np.zeros(rows.n, np.int64)
    gained, _ = play_to_the_end(rows, act, Offsets(nowhere, np.zeros(rows.n), nowhere), gamma)
    return gained, rows.ledger.world_harm(engine.reward.harm_count if count is None else count)


def show_templates(engine: Engine, plan: ModesPlan, found: Explored, gamma: float, seed: int) -> Shown:
    """What the best template does in each world in which it gains more, by ``plan.gain``, than every network."""
    (vehicle,) = engine.learners
    problem = profile_problem(
        found.alert,
        [vehicle],
        harm_count=engine.reward.harm_count,
        horizon_s=engine.scenario.horizon_s,
        time_step_s=engine.scenario.time_step_s,
        others_mps2=found.start.wanted,
    )
    commands, steps = best_templates(problem, found.harm, number=plan.templates, seed=seed)
    rows = np.flatnonzero(steps > 0)
    worlds = found.alert.take(rows).vehicles
    each = [command_to_action(commands[rows, t], worlds, vehicle) for t in range(commands.shape[1])]
    actions = np.stack(each, axis=1)  # [rows, T]
    seen_then: list[Observations] = []
    where: list[Ints] = []

    def decide(seen: Observations, some: Ints, number: int) -> Floats:
        seen_then.append(seen[:, 0])
        where.append(some)
        wanted: Floats = actions[some, number][:, np.newaxis]
        return wanted

    gained = play_on(engine.branch(found.start.take(rows)), decide, gamma)[:, 0]
    better: Bools = gained > found.gained[rows] + plan.gain
    if not where:
        return Shown(np.zeros((0, engine.observation.size), np.float32), np.zeros(0, np.float32))
    wanted = np.concatenate([actions[some, number] for number, some in enumerate(where)]).astype(np.float32)
    kept = better[np.concatenate(where)]
    return Shown(np.concatenate(seen_then)[kept], wanted[kept])


def own_worlds(engine: Engine, plan: ModesPlan, found: Explored, act: Act, gamma: float) -> Moment:
    """The starts of the worlds in which ``act`` is at most ``plan.margin`` worse than the networks before it.

    Those where it makes no difference are left out, and those where the networks before do no harm: they teach nothing.
    """
    gained, _ = drive_from(engine, found.start, act, gamma)
    more = gained - found.gained
    rows = np.flatnonzero((more > -plan.margin) & (np.abs(more) > NO_DIFFERENCE) & (found.harm > 0.0))
    return found.start.take(rows)


class NoOtherMode(EthBrakeError, ValueError):
    """No template does better than the networks so far: there is no other mode to be learned."""


class ModesPolicy(_Deterministic):
    """Several actors and a gate; under the names that ``NetworkSpec.tensors`` has for them."""

    def __init__(
        self, observation_space: Space[Any], action_space: Any, rate: Schedule, recipe: CounterfactualRecipe
    ) -> None:
        super().__init__(observation_space, action_space)
        assert recipe.modes is not None
        networks = range(recipe.modes.networks)
        self.actors = [AveragedActor(observation_space, action_space, rate, recipe) for _ in networks]
        self.members = nn.ModuleList(self.actors)
        self.gate = AveragedGate(flatdim(observation_space), rate, recipe)

    def _chosen(self, observation: Float32s, ask: Callable[[AveragedActor, Float32s], NDArray[Any]]) -> Floats:
        """What the actors answer where the gate chooses them, [rows]."""
        chosen, found = self.gate.choose(observation), np.empty(len(observation))
        for number, actor in enumerate(self.actors):
            rows = np.flatnonzero(chosen == number)
            found[rows] = ask(actor, observation[rows])
        return found

    def means(self, observation: Float32s) -> Float32s:
        return self._chosen(observation, AveragedActor.means).astype(np.float32)  # which they were

    def expect(self, observation: Float32s) -> Floats:
        return self._chosen(observation, AveragedActor.expect)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the averages."""
        chosen = self.gate.average(observation).argmax(dim=1, keepdim=True)
        return torch.cat([actor(observation) for actor in self.actors], dim=1).gather(1, chosen)


class ModesModel(CounterfactualModel):
    """Learns a network alone, further ones in the worlds of their own modes, the gate, and then all together."""

    policy: ModesPolicy  # type: ignore[assignment]

    def __init__(self, environment: EthBrakeVecEnv, recipe: CounterfactualRecipe) -> None:
        assert recipe.modes is not None
        self.plan = recipe.modes
        self._stage: Stage | None = None
        self._own: Moment | None = None  # starts of the worlds of the stage's network
        self._rate_share = 1.0
        super().__init__(environment, recipe)

    def _update(self, told: BaseCallback, total: int) -> None:
        each = self.n_envs * self.recipe.n_steps
        number, policy = self.num_timesteps // each, self.policy
        stage = next(s for s in stages_of(self.plan, -(-total // each)) if s.first <= number < s.end)
        if stage != self._stage:
            self._enter(stage, number)
        member = policy.actors[stage.network]
        if stage.does == "further":  # whole episodes in some of the stage's own worlds
            assert self._own is not None
            some = torch.randint(len(self._own.state), (self.n_envs,)).numpy()
            found, moments = visit(self.engine.branch(self._own.take(some)), member.act)
            seen = found.reshape(1, -1, found.shape[2])
            self.num_timesteps += each
        else:
            seen, moments = self._visit(told, member.act if stage.does == "alone" else policy.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(number - stage.first, stage.end - stage.first)
        self._rate_share = self.plan.together_rate if stage.does == "together" else 1.0
        if stage.does in ("alone", "further"):
            self._train(member, self._try_out(seen, moments, member))
            return
        if stage.does == "together":  # each network on what was tried where the gate chooses it
            tried = self._try_out(seen, moments, policy)
            chosen = policy.gate.choose(tried.seen)
            for k, actor in enumerate(policy.actors):
                rows = np.flatnonzero(chosen == k)
                if len(rows) > 1:
                    self._train(actor, Tried(*(array[rows] for array in tried)))
        self._train_gate(*self._compare(seen, moments))

    def _update_learning_rate(self, optimizers: list[torch.optim.Optimizer] | torch.optim.Optimizer) -> None:
        assert isinstance(optimizers, torch.optim.Optimizer)
        rate = self._rate_share * self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
        update_learning_rate(optimizers, rate)

    def _enter(self, stage: Stage, number: int) -> None:
        """Prepare a stage. After a resume this finds the same again: it depends on finished networks alone."""
        self._stage, self._own = stage, None
        if stage.does != "further":
            return
        engine, gamma = self.engine, self.recipe.gamma
        before = [actor.act for actor in self.policy.actors[: stage.network]]
        found = explore(engine, self.plan, before, gamma)
        seed = int(self.seed or 0)
        shown = show_templates(engine, self.plan, found, gamma, seed)
        pupil = copy.deepcopy(self.policy.actors[0])
        self._imitate(pupil, shown, seed + stage.network)
        self._own = own_worlds(engine, self.plan, found, pupil.act, gamma)
        if len(shown.action) == 0 or len(self._own.state) == 0:
            raise NoOtherMode(
                f"modes: network {stage.network + 1}: in none of {self.plan.worlds:,} worlds did one of"
                f" {self.plan.templates} templates do better by {self.plan.gain:g}; leave out modes, or have"
                " fewer networks"
            )
        if number == stage.first:
            self.policy.actors[stage.network].load_state_dict(pupil.state_dict())

    def _imitate(self, pupil: AveragedActor, shown: Shown, seed: int) -> None:
        """Teach a network what templates do."""
        pupil.optimizer = adam(self.lr_schedule(1.0), pupil.learning)
        seen, wanted = torch.from_numpy(shown.seen), torch.from_numpy(shown.action)
        generator = torch.Generator().manual_seed(seed)
        for _ in range(self.plan.imitation_epochs):
            for batch in torch.split(torch.randperm(len(wanted), generator=generator), self.recipe.batch_size):
                means, target = pupil.learning(seen[batch])[:, 0], wanted[batch]
                reached = (target.abs() >= 1.0) & (means * target >= 1.0)  # beyond a bound it means the bound
                loss = mse_loss(means, torch.where(reached, means.detach(), target))
                descend(pupil.optimizer, loss)
        follow(pupil.average, pupil.learning, 0.0)

    def _compare(self, seen: Float32s, moments: Moment) -> tuple[Float32s, Floats, Float32s]:
        """At some decisions: what is seen [B, F], what going on with each network costs [B, K], what each counts [B].

        Where all networks would do the same now nothing depends on the choice: the gate is asked again at the next one.
        """
        engine, members = self.engine, [actor.act for actor in self.policy.actors]
        observed = seen.reshape(-1, seen.shape[2])
        actions = np.stack([act(observed) for act in members])
        differ = (np.ptp(actions, axis=0) > 1e-2) & moving_rows(moments)
        count, scout = self.plan.gate_states, self.policy.gate.scout
        expect = None if scout is None else scout.expect
        rows, importance = choose_rows(observed, np.flatnonzero(differ), count, self.recipe.focus, expect)
        other = other_count(engine.reward.harm_count)
        then = moments.take(rows)
        costs = np.empty((len(rows), len(members)))
        for number, act in enumerate(members):
            gained, harm = drive_from(engine, then, act, self.recipe.gamma, other)
            costs[:, number] = self.plan.tie_break * harm - gained
        good = np.isfinite(costs).all(axis=1)
        return observed[rows[good]], costs[good], importance[good]

    def _train_gate(self, seen: Float32s, costs: Floats, importance: Float32s | None = None) -> None:
        """Teach the gate which network costs least, each decision as much as the others would cost more."""
        importance = np.ones(len(seen), np.float32) if importance is None else importance
        gate = self.policy.gate
        self._update_learning_rate(gate.optimizer)
        more = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        rows = np.flatnonzero(more.max(axis=1) > 1e-9)
        gate.remember(seen[rows], more[rows] * importance[rows, np.newaxis])
        if gate.scout is not None:
            arrays = [torch.from_numpy(array) for array in (seen, more.max(axis=1), importance)]
            for batch in torch.split(torch.randperm(len(seen)), self.recipe.batch_size):
                descend(gate.optimizer, gate.scout.loss(*(array[batch] for array in arrays)))
        if len(rows):
            regret = np.take_along_axis(more[rows], gate.choose(seen[rows])[:, np.newaxis], axis=1)
            self.logger.record("gate/regret", float((regret[:, 0] * importance[rows]).mean()))
        if int(gate.compared) == 0:
            return
        losses = []
        for _ in range(self.plan.gate_steps):
            inputs, costlier = gate.recall(self.recipe.batch_size)
            scores = gate.learning(inputs)
            best = scores.gather(1, costlier.argmin(dim=1, keepdim=True))
            loss = (costlier * softplus(scores - best)).sum(dim=1).mean()
            descend(gate.optimizer, loss)
            follow(gate.average.parameters(), gate.learning, self.recipe.averaging)
            losses.append(loss.item())
        self.logger.record("gate/loss", float(np.mean(losses)))
