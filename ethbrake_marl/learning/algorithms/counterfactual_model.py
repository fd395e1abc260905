"""The model that learns from counterfactuals: an actor, its average, and the loop around them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import MaybeCallback, PyTorchObs, Schedule
from torch import Tensor, nn

from ethbrake_marl.engine.snapshot import Act, Moment, Offsets, branch, join_moments, moment_of, play_to_the_end
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS, Adam, Scout, choose_rows
from ethbrake_marl.learning.recipe import ActorShape
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.advance import command_at, speed_at
from ethbrake_marl.policies.actor import Float32s, tensor_table

LOG_NOISE = -3.0  # of the bundle: the actor itself never explores


class AveragedActor(BasePolicy):
    """An actor that learns (``learning``), and the running average of its weights, which drives.

    The average stands under the names of Stable-Baselines3's PPO, as a bundle wants it.
    """

    def __init__(
        self, observation_space: Space[Any], action_space: Any, rate: Schedule, shape: ActorShape, focus: float = 0.0
    ) -> None:
        super().__init__(observation_space, action_space)
        assert isinstance(observation_space, Box)
        inputs, activation = observation_space.shape[0], ACTIVATIONS[shape.activation]
        hidden = create_mlp(inputs, -1, list(shape.policy), activation)
        self.mlp_extractor = nn.ModuleDict({"policy_net": nn.Sequential(*hidden)})
        self.action_net = nn.Linear(shape.policy[-1], 1)
        for layer in self._layers(self.mlp_extractor["policy_net"]):
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.action_net.weight, 0.01)
        nn.init.constant_(self.action_net.bias, shape.initial_action or 0.0)
        self.log_std = nn.Parameter(torch.full((1,), LOG_NOISE), requires_grad=False)
        last = nn.Linear(shape.policy[-1], 1)
        self.learning = nn.Sequential(*create_mlp(inputs, -1, list(shape.policy), activation), last)
        self._spec = shape.spec(inputs)
        average = [*self._layers(self.mlp_extractor["policy_net"]), self.action_net]
        pairs = list(zip(average, self._layers(self.learning), strict=True))
        self._pairs = [
            (getattr(mean, name), getattr(learns, name)) for mean, learns in pairs for name in ("weight", "bias")
        ]
        self._average(0.0, towards_learning=False)
        self.scout = Scout(inputs) if focus > 0.0 else None
        learned = [*self.learning.parameters(), *(self.scout.parameters() if self.scout is not None else ())]
        self.optimizer = Adam(learned, lr=rate(1.0), eps=1e-5)

    def take_over(self, tensors: Mapping[str, Float32s]) -> None:
        """Begin with these tensors of a bundle."""
        state = self.state_dict()
        for row in tensor_table(self._spec):
            state[row.sb3_name].copy_(torch.from_numpy(tensors[row.name]))
        self._average(0.0, towards_learning=False)

    def follow(self, keep: float) -> None:
        """Move the average towards the weights that learn, keeping this share of what it was."""
        self._average(keep, towards_learning=True)

    def means(self, observation: Float32s) -> Float32s:
        """What the actor that learns says to observations [rows, F], [rows]; beyond -1 and 1 it means -1 and 1."""
        with torch.no_grad():
            values = torch.from_numpy(observation)
            for layer in self.learning:
                values = values.relu_() if isinstance(layer, nn.ReLU) else layer.forward(values)
        found: Float32s = values[:, 0].numpy()
        return found

    def act(self, observation: Float32s) -> Float32s:
        """Its actions [rows] in [-1, 1]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that its scout expects, [rows]."""
        assert self.scout is not None
        return self.scout.expect(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        means: Tensor = self.action_net(self.mlp_extractor["policy_net"](observation))
        return means.clamp(-1.0, 1.0)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        return self.forward(observation)

    def _average(self, keep: float, *, towards_learning: bool) -> None:
        with torch.no_grad():
            for mean, learns in self._pairs:
                if towards_learning:
                    mean.lerp_(learns, 1.0 - keep)
                else:
                    learns.copy_(mean)

    @staticmethod
    def _layers(network: nn.Module) -> list[nn.Linear]:
        return [layer for layer in network.modules() if isinstance(layer, nn.Linear)]


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and what that brought."""

    seen: Float32s  # [B, F]
    mean: Float32s  # [B] what the actor said; beyond -1 and 1 it means -1 and 1
    gradient: Float32s  # [B] of the return by the action
    importance: Float32s  # [B] what each counts


class TryingOut(NamedTuple):
    """How decisions are tried out, and what is learned from them."""

    n_steps: int  # decisions of each world between two updates
    counterfactuals: int  # of them that are tried in two ways
    offset: tuple[float, float]  # smallest and largest
    holds: tuple[int, ...]  # steps
    gamma: float
    gradient_limit: float  # a jump counts as no more
    trust_radius: float
    anchor: float
    n_epochs: int
    batch_size: int
    averaging: float
    focus: float = 0.0  # share of what is tried that a scout chooses


class Actor(Protocol):
    """What is tried out; its actions are its means, cut at -1 and 1."""

    def means(self, observation: Float32s) -> Float32s:
        """Of observations [rows, F], [rows]."""

    def act(self, observation: Float32s) -> Float32s:
        """Actions [rows] in [-1, 1]."""

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that its scouts expect, [rows]."""


class CounterfactualModel(BaseAlgorithm):
    """Visits decisions by its deterministic actor, tries some of them in two ways, and learns from the difference."""

    policy: AveragedActor

    def __init__(self, environment: EthBrakeVecEnv, shape: ActorShape, how: TryingOut, **settings: Any) -> None:
        super().__init__(
            AveragedActor,
            environment,
            stats_window_size=max(100, environment.num_envs),
            device="cpu",
            support_multi_env=True,
            **settings,
        )
        self.how, self._shape = how, shape
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = AveragedActor(
            self.observation_space, self.action_space, self.lr_schedule, self._shape, self.how.focus
        )

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
        assert isinstance(self.env, EthBrakeVecEnv)
        seen, moments = [], []
        for _ in range(self.how.n_steps):
            observations: Any = self._last_obs
            seen.append(observations)
            moments.append(moment_of(self.env.engine))
            new_obs, rewards, dones, infos = self.env.step(act(observations)[:, np.newaxis])
            self.num_timesteps += self.env.num_envs
            self._update_info_buffer([infos[row] for row in np.flatnonzero(dones)], dones[dones])  # others tell nothing
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            told.update_locals(locals())
            told.on_step()
        return np.stack(seen), join_moments(moments)

    def _try_out(self, seen: Float32s, moments: Moment, actor: Actor) -> Tried:
        """Try some of the visited decisions with more and with less, each to the end of its episode."""
        assert isinstance(self.env, EthBrakeVecEnv)
        how, learners = self.how, len(self.env.engine.learners)
        moving = np.flatnonzero(moving_rows(moments, self.env.engine.scenario.vehicles).repeat(learners))
        observed = seen.reshape(-1, seen.shape[2])
        rows, importance = choose_rows(observed, moving, how.counterfactuals, how.focus, actor.expect)
        sizes = _log_uniform(*how.offset, len(rows))
        holds = np.array(how.holds, np.int64)[torch.randint(len(how.holds), (len(rows),)).numpy()]
        both = np.concatenate([sizes, -sizes])
        worlds: Ints = np.tile(rows // learners, 2)
        engine = branch(self.env.engine, moments.take(worlds))
        offsets = Offsets(np.tile(rows % learners, 2), both, np.tile(holds, 2))
        gained, moved = play_to_the_end(engine, actor.act, offsets, how.gamma)
        gradient = np.clip(_difference(gained) / _difference(moved), -how.gradient_limit, how.gradient_limit)
        good = np.isfinite(gradient)
        then = observed[rows[good]]
        return Tried(then, actor.means(then), gradient[good].astype(np.float32), importance[good])

    def _train(self, actor: AveragedActor, tried: Tried) -> None:
        """Regress the actor on actions that are better, within the trust radius; log what that was."""
        how = self.how
        self._update_learning_rate(actor.optimizer)
        target, weight = trusted_targets(tried, how.trust_radius, how.anchor)
        arrays = (tried.seen, target, weight * tried.importance, np.abs(tried.gradient), tried.importance)
        seen, wanted, weights, sizes, importance = (torch.from_numpy(array) for array in arrays)
        losses = []
        for _ in range(how.n_epochs):
            for batch in torch.split(torch.randperm(len(wanted)), how.batch_size):
                means = actor.learning(seen[batch])[:, 0]
                loss = (weights[batch] * (means - wanted[batch]) ** 2).mean()
                actor.optimizer.zero_grad()
                loss.backward()
                if actor.scout is not None:
                    actor.scout.loss(seen[batch], sizes[batch], importance[batch]).backward()  # type: ignore[no-untyped-call]
                actor.optimizer.step()
                actor.follow(how.averaging)
                losses.append(loss.item())
        self._n_updates += how.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(np.abs(tried.gradient).mean()) if len(wanted) else 0.0)
        self.logger.record("train/counterfactuals", len(wanted))


def moving_rows(moments: Moment, vehicles: int) -> Bools:
    """In which rows some vehicle moves; where everything stands there is nothing to learn."""
    moving: Bools = (moments.state[:, speed_at(vehicles) : command_at(vehicles)] != 0.0).any(axis=1)
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


def _difference(values: Floats) -> Floats:
    """The first half minus the second."""
    half = len(values) // 2
    return values[:half] - values[half:]


def _log_uniform(smallest: float, largest: float, count: int) -> NDArray[np.float64]:
    share = torch.rand(count, dtype=torch.float64).numpy()
    drawn: NDArray[np.float64] = smallest * (largest / smallest) ** share
    return drawn
