"""Model of vine: at some decisions it tries a higher and a lower action, and learns from the difference in return."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import Tensor

from ethbrake_marl.extensions.learners.averaged_actor import AveragedActor, Deterministic
from ethbrake_marl.extensions.learners.branches import Act, Offsets, moving_rows, play_to_the_end
from ethbrake_marl.extensions.learners.gradient_limit import CUT, REMEMBERED, limit_that_cuts, smallest_offset
from ethbrake_marl.extensions.learners.mixture_policy import ExpertsPolicy
from ethbrake_marl.extensions.learners.optimizer import descend, follow
from ethbrake_marl.extensions.learners.scout import choose_rows
from ethbrake_marl.extensions.learners.trust_radius import Tried, trusted_targets
from ethbrake_marl.extensions.learners.vine_recipe import VineRecipe
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.policies.network_spec import Float32s


class VineModel(BaseAlgorithm):
    """Model that drives with a deterministic actor, and measures gradients of the return at some decisions.

    The model tries one action above and one below the actor's action. The difference between the two returns gives the
    gradient of the return with respect to the action.

    Args:
        environment: environment in which the model is trained.
        recipe: recipe of the training run.

    """

    policy: AveragedActor

    def __init__(self, environment: EthBrakeVecEnv, recipe: VineRecipe) -> None:
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
        kind: Any = AveragedActor if self.recipe.experts is None else ExpertsPolicy
        self.policy = kind(self.observation_space, self.action_space, self.lr_schedule, self.recipe)
        if self.recipe.gradient_limit == "auto":  # a buffer, so that a checkpoint saves it
            self.policy.register_buffer("measured", torch.zeros(REMEMBERED, 2, dtype=torch.float64))

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "vine",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train until the learners have made ``total_timesteps`` decisions.

        The arguments are those of Stable-Baselines3's method ``learn``.
        """
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            callback.on_rollout_start()
            self._update(callback, total)
        callback.on_training_end()
        return self

    def _update(self, callback: BaseCallback, total: int) -> None:
        """Make one update of a training run of ``total`` decisions: collect decisions, and learn from them."""
        actor = self.policy
        seen, moments = self._visit(callback, actor.act)
        callback.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._train(actor, self._try_out(seen, moments, actor))

    def _visit(self, callback: BaseCallback, act: Act) -> tuple[Float32s, State]:
        """Drive all worlds for ``n_steps`` decisions with ``act``; call ``callback`` after each decision.

        Returns the observations [n_steps, rows, F], and the states of the worlds at the visited decisions.
        """
        seen, moments, numbers = [], [], []
        for _ in range(self.recipe.n_steps):
            observations: Any = self._last_obs
            seen.append(observations)
            numbers.append(self.engine.roster.numbers.copy())
            moments.append(self.engine.moment())
            new_obs, rewards, dones, infos = self.rows.step(act(observations)[:, np.newaxis])
            self.num_timesteps += self.n_envs
            self._update_info_buffer(
                [infos[row] for row in np.flatnonzero(dones)], dones[dones]
            )  # only ended episodes have statistics
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            callback.update_locals(locals())
            callback.on_step()
        self._numbers = np.concatenate(numbers)  # index of each visited world in the training
        return np.stack(seen), State.join(moments)

    def _try_out(self, seen: Float32s, moments: State, actor: Deterministic) -> Tried:
        """At some visited decisions, try a higher and a lower action, and simulate the episode to its end after each.

        A tried action is the action of ``actor`` plus or minus an offset. ``seen`` [steps, rows, F] are the
        observations at the visited decisions, and ``moments`` the states of the worlds.
        """
        recipe, learners = self.recipe, len(self.engine.learners)
        moving = np.flatnonzero(moving_rows(moments).repeat(learners))
        observed = seen.reshape(-1, seen.shape[2])
        rows, importance = choose_rows(observed, moving, recipe.tried, recipe.focus, actor.expect)
        least, most = recipe.offset.smallest, recipe.offset.largest
        memory: Tensor | None = getattr(self.policy, "measured", None)  # only if the gradient limit is auto
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
        """Train ``actor``: move its outputs at the decisions in ``tried`` towards their ``trusted_targets``."""
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
                losses_of_step = [loss]
                if actor.scout is not None:
                    losses_of_step.append(actor.scout.loss(seen[batch], sizes[batch], importance[batch]))
                descend(actor.optimizer, *losses_of_step)
                follow(actor.average, actor.learning, recipe.averaging)
                losses.append(loss.item())
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(np.abs(tried.gradient).mean()) if len(wanted) else 0.0)
        self.logger.record("train/tried", len(wanted))
