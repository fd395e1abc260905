"""Vine: try a higher and a lower action in the same state; the difference in return is the gradient of the return.

The name is from Schulman et al. 2015 (TRPO), who sample branches from visited states with common random numbers. A
*branch* is a copy of a running episode that is simulated to its end with other actions. Branches of one state have the
same random numbers, so they differ only in the actions.

n: branches, or worlds; m: branches that still run; L: learners, front to rear; F: features.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import Tensor, nn

from ethbrake_marl.episode.counts import amount_so_far
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import TIME, State
from ethbrake_marl.extensions.learners.actor import Actor
from ethbrake_marl.extensions.learners.recipe import VineRecipe
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import FORCE, GAP, HIT, LATENCY, SPEED, Bools, Floats, Ints
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.training.algorithm import Algorithm, tensors_of
from ethbrake_marl.training.training import Training

ROUNDING_MPS2 = 1e-5  # forces closer than this are equal: a network's rounding depends on its batch size

Act = Callable[[Observations], Float32s]  # observations [rows, F] -> actions [rows] in [-1, 1]


class Vine(Algorithm):
    """Algorithm vine. One policy controls all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> VineModel:
        return VineModel(training, environment)

    def tensors(self, actor: Actor, network: NetworkSpec) -> dict[str, Float32s]:
        log_std = {"policy.log_std": np.full(1, -3.0, np.float32)}  # which never counts, because vine does not explore
        return tensors_of("policy", actor.average) | log_std


class Visited(NamedTuple):
    """Decisions of L learners in D visited states."""

    observations: Float32s  # [D * L, F]
    states: State  # [D]


class Branches(NamedTuple):
    """Two branches of each of B visited decisions: first B with a higher action, then B with a lower one."""

    world: Ints  # [2B] number of the visited state
    learner: Ints  # [2B] learner whose action is moved, from 0
    size: Floats  # [2B] by how much the action is moved
    steps: Ints  # [2B] for how many steps the action is moved

    def decisions(self, learners: int) -> Ints:
        return (self.world * learners + self.learner)[: len(self.world) // 2]


class TrialResults(NamedTuple):
    """Results at B decisions at which a higher and a lower action were tried."""

    seen: Tensor  # [B, F] observations
    mean: Tensor  # [B] output of the actor, not clipped
    gradient: Tensor  # [B] of the return with respect to the action


class VineModel(BaseAlgorithm):
    """Drives all worlds without exploration, tries other actions in branches, and learns from their returns."""

    policy: Any  # an `Actor`

    def __init__(self, training: Training, environment: EthBrakeVecEnv) -> None:
        recipe = training.recipe
        assert isinstance(recipe, VineRecipe)
        super().__init__(
            nn.Module,  # type: ignore[arg-type]  # only models that explore need a policy of Stable-Baselines3
            environment,
            learning_rate=recipe.learning_rate.at,
            stats_window_size=max(100, environment.num_envs),
            device="cpu",
            support_multi_env=True,
            seed=recipe.seed,
        )
        self.recipe = recipe
        self.rows, self.features = environment, training.row.names
        self.learners, self.simulated = len(environment.bodies), 0  # decisions in branches since the last update
        self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = Actor(self.features, self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def dump_logs(self) -> None:
        self.logger.dump(step=self.num_timesteps)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Repeat ``collect`` and ``improve`` for ``total_timesteps`` decisions, with the calls of Stable-Baselines3."""
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            callback.on_rollout_start()
            visited = self.collect(callback)
            callback.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total)
            self.train_actor(self.try_out(visited))
        callback.on_training_end()
        return self

    def collect(self, callback: BaseCallback) -> Visited:
        """Drive all worlds for ``n_steps`` decisions."""
        all_observations: list[Any] = []
        states: list[State] = []
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            all_observations.append(observations)
            states.append(self.rows.episode.take(np.arange(self.rows.n)))
            new_obs, rewards, dones, infos = self.rows.step(self.policy.act(observations)[:, np.newaxis])
            self.num_timesteps += self.n_envs
            ended = [infos[row] for row in np.flatnonzero(dones)]  # only these have statistics
            self._update_info_buffer(ended, dones[dones])
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            callback.update_locals(locals())
            callback.on_step()
        return Visited(np.concatenate(all_observations), State.join(states))

    def try_out(self, visited: Visited) -> TrialResults:
        """Results at random visited decisions, simulated with a higher and with a lower action than the policy's."""
        branches = self.draw_branches(np.flatnonzero(moving(visited.states).repeat(self.learners)))
        gained, moved = self.play(visited.states, branches)
        sample = visited.observations[branches.decisions(self.learners)]
        gradient = self.measured_gradient(torch.from_numpy(gained), torch.from_numpy(moved))
        return TrialResults(torch.from_numpy(sample), torch.from_numpy(self.policy.means(sample)), gradient)

    def draw_branches(self, decisions: Ints) -> Branches:
        rows = decisions[torch.randperm(len(decisions))[: self.recipe.tried].numpy()]
        offset, holds = self.recipe.offset, np.array(self.recipe.holds, np.int64)
        ratio = offset.largest / offset.smallest
        sizes: Floats = offset.smallest * ratio ** torch.rand(len(rows), dtype=torch.float64).numpy()
        steps = holds[torch.randint(len(holds), (len(rows),)).numpy()]
        world, learner = np.divmod(np.tile(rows, 2), self.learners)
        return Branches(world, learner, np.concatenate([sizes, -sizes]), np.tile(steps, 2))

    def play(self, states: State, branches: Branches) -> tuple[Floats, Floats]:
        """Discounted return of each branch's learner, and how far its actions were moved, [2B] each.

        An action stays in [-1, 1], so it may move by less than ``size``. Moves are summed over the steps.
        """
        world, learner, size, steps = branches
        moved, longest = np.zeros(len(size)), int(steps.max(initial=0))

        def decide(now: Moment) -> Floats:
            actions = now.ask(self.policy.act)
            self.simulated += actions.size
            held = np.flatnonzero(now.number < steps[now.rows]) if now.number < longest else steps[:0]
            row = now.rows[held]
            before = actions[held, learner[row]]
            after = np.clip(before + size[row], -1.0, 1.0)
            actions[held, learner[row]] = after
            moved[row] += after - before
            return actions

        gained = play_on(self.rows.game, states.take(world), decide, self.recipe.gamma, at_least=longest)
        return gained[np.arange(len(size)), learner], moved

    def measured_gradient(self, gained: Tensor, moved: Tensor) -> Tensor:
        """Gradient of the return at each decision, [B] float32, limited to the recipe's ``gradient_limit``.

        ``gained``, ``moved`` [2B]: results of ``play``.
        """
        (up, down), (higher, lower) = gained.chunk(2), moved.chunk(2)
        measured = (up - down) / (higher - lower)
        gradient = measured.clamp(-self.recipe.gradient_limit, self.recipe.gradient_limit)
        total = float(measured.abs().sum())
        self.logger.record_mean("train/gradient_cut", 1.0 - float(gradient.abs().sum()) / total if total else 0.0)
        return gradient.float()

    def train_actor(self, results: TrialResults) -> None:
        """Train the actor by gradient descent towards its ``trusted_targets``."""
        recipe = self.recipe
        self._update_learning_rate(self.policy.optimizer)
        lesson, losses = (results.seen, *trusted_targets(results, recipe.trust_radius, recipe.anchor)), []
        for _ in range(recipe.n_epochs):
            for batch in torch.split(torch.randperm(len(results.seen)), recipe.batch_size):
                observations, target, weight = (part[batch] for part in lesson)
                loss = (weight * (self.policy.learning(observations)[:, 0] - target) ** 2).mean()
                losses.append(self.policy.descend(loss, recipe.averaging).item())
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(results.gradient.abs().mean()) if losses else 0.0)
        self.logger.record("train/tried", len(results.seen))
        self.logger.record("train/simulated", self.simulated)
        self.simulated = 0


def trusted_targets(results: TrialResults, radius: float, anchor: float) -> tuple[Tensor, Tensor]:
    """Targets of the actor's outputs, and the weights of the squared errors in the loss, [B] each.

    Let m be the present output and g the slope of the return at m. Then ``weight = |g| / radius + anchor`` and ``target
    = m + g / weight``: the target is less than ``radius`` away, and ``(weight / 2) (output - target)^2`` has the slope
    ``-g`` at m. An output at or beyond 1 is not moved farther out, because actions are clipped to [-1, 1].
    """
    outward = ((results.mean >= 1.0) & (results.gradient > 0.0)) | ((results.mean <= -1.0) & (results.gradient < 0.0))
    gradient = results.gradient.masked_fill(outward, 0.0)
    weight = gradient.abs() / radius + anchor
    return results.mean + gradient / weight, weight


class Moment(NamedTuple):
    """One decision in all branches that still run."""

    state: State
    seen: Observations  # [m, L, F]
    rows: Ints  # [m] number of each branch, from 0
    number: int  # steps so far

    def ask(self, act: Act) -> Floats:
        """Actions of all learners, chosen by the policy ``act``, [m, L] float64."""
        return act(self.seen.reshape(-1, self.seen.shape[2])).astype(np.float64).reshape(self.seen.shape[:2])


def play_on(game: Game, state: State, decide: Callable[[Moment], Floats], gamma: float, *, at_least: int = 0) -> Floats:
    """Simulate episodes to the end; return each learner's discounted return, [n, L].

    ``decide`` returns the learners' actions at a ``Moment``, [m, L]. ``gamma``: discount per step. If harm is the
    reward's only term, an episode also ends, after ``at_least`` steps, when no vehicle will ever move again.
    """
    learners, only_harm = game.settings.learners, set(game.rewarding.counted) <= {"harm"}
    gained, rows = np.zeros((state.n, len(learners))), np.flatnonzero(~state.ended)
    now, discount, number = state.take(rows), 1.0, 0
    while len(rows):
        after, step = game.step(now, decide(Moment(now, game.observe_alike(now, learners), rows, number)))
        gained[rows] += discount * step.reward[:, learners - 1]
        over = after.ended
        if only_harm and number >= at_least:
            over |= stands_for_good(now, after, game.settings.harm_count.weight_array)
        if over.any():
            rows, after = rows[~over], after.take(~over)
        now, discount, number = after, discount * gamma, number + 1
    return gained


def stands_for_good(before: State, after: State, weights: Floats) -> Bools:
    """Whether all vehicles of a world stand and will never move again, if actions depend only on observations, [n].

    True if this step changed nothing, no vehicle waits for its latency or a message, and no vehicle presses against one
    that it could still push (in the count of harm with these ``weights`` [6]). Always False if scripts, messages or a
    shield have a memory.
    """
    out = np.zeros(after.n, np.bool_)
    if not after.memories:
        find_standing(before.line, after.line, after.car, after.know, before.clock, weights, out)
    return out


@large
def find_standing(
    before: Floats, line: Floats, car: Floats, know: Floats, clock: Floats, weights: Floats, out: Bools
) -> None:
    """Write the result of ``stands_for_good`` to ``out`` [n]. ``before``, ``line``: ``State.line`` before and after."""
    bodies = line.shape[2]
    for k in range(len(out)):
        time = clock[k, TIME]
        grown = amount_so_far(line[k], weights) - amount_so_far(before[k], weights)
        stands = grown == 0.0
        for i in range(bodies):
            stands = stands and before[k, SPEED, i] == 0.0 and line[k, SPEED, i] == 0.0
        if stands:
            for i in range(bodies):
                stands = stands and before[k, GAP, i] == line[k, GAP, i] and before[k, HIT, i] == line[k, HIT, i]
                stands = stands and abs(before[k, FORCE, i] - line[k, FORCE, i]) < ROUNDING_MPS2
                stands = stands and (car[k, LATENCY, i] < time or car[k, LATENCY, i] == math.inf)
                for j in range(bodies):
                    stands = stands and (know[k, i, j] < time or know[k, i, j] == math.inf)
        out[k] = stands


def moving(state: State) -> Bools:
    """Whether any vehicle of a world moves, [n]."""
    return np.asarray(state.line[:, SPEED].any(axis=1))
