"""The training algorithm vine on a GPU: episodes, branches and the network's training run on the device.

Random numbers are drawn on the processor, so they are the same as in a training on a processor.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Self

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor, nn

from ethbrake_marl.episode.state import ENDED
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cuda.device import enough_memory
from ethbrake_marl.extensions.cuda.graphs import Graphed
from ethbrake_marl.extensions.cuda.kernels import StoredEpisodes
from ethbrake_marl.extensions.cuda.worlds import POOL, Worlds
from ethbrake_marl.extensions.learners.algorithms import Vine
from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.extensions.learners.vine import ClippedActor, TrialResults, VineModel
from ethbrake_marl.faces.sb3 import EthBrakeVecEnv
from ethbrake_marl.training.training import Training


class CudaVine(Vine):
    """The algorithm vine on the device that the recipe names."""

    def new_model(self, training: Training, environment: EthBrakeVecEnv) -> CudaVineModel:
        """New model, with the same random weights as on a processor.

        Raises ``InvalidInput`` if ``batch_size`` does not divide ``tried``, for games that ``Worlds`` refuses, and for
        more worlds than the device has memory for.
        """
        recipe = training.recipe
        assert isinstance(recipe, VineRecipe)
        if recipe.tried % recipe.batch_size:
            raise InvalidInput(
                f"{recipe_and_device(recipe)}: batch_size = {recipe.batch_size}: must divide tried = {recipe.tried}"
                " there"
            )
        with enough_memory(sizes(recipe)):
            return CudaVineModel(training, environment, self.device_of(recipe))

    def device_of(self, recipe: VineRecipe) -> str:
        return recipe.device


def recipe_and_device(recipe: VineRecipe) -> str:
    return f"recipe {recipe.name!r} on device {recipe.device!r}"


def sizes(recipe: VineRecipe) -> str:
    return f"{recipe_and_device(recipe)}: n_envs = {recipe.n_envs}, n_steps = {recipe.n_steps}, tried = {recipe.tried}"


class CudaVineModel(VineModel):
    """Model of vine on a GPU. It visits decisions in ``worlds``, and tries other actions in ``branches``.

    The environment that the training has built for Stable-Baselines3 is not stepped. n: worlds; L: learners; F:
    features; B: tried decisions; D: visited decisions of one learner, n times n_steps.
    """

    def __init__(self, training: Training, environment: EthBrakeVecEnv, device: str) -> None:
        recipe: Any = training.recipe
        new = partial(Worlds, training.scenario, device=device, reward=recipe.reward, seed=recipe.seed)
        feature_names = list(training.row.names)
        self.worlds = new(recipe.n_envs, POOL, observation=feature_names)
        self.branches = new(2 * recipe.tried, self.worlds.game.draw(1, recipe.seed, 0), observation=feature_names)
        super().__init__(training, environment)
        count, place, zeros = recipe.n_envs * recipe.n_steps, self.worlds.device, torch.zeros
        kind = self.worlds.pool.line.dtype
        self.visited = StoredEpisodes(
            *(zeros(*part.shape[:-1], count, dtype=kind, device=place) for part in self.worlds.pool)
        )
        self.seen = self.worlds.reset().repeat(recipe.n_steps, 1, 1)  # [D, L, F]
        self.each_learner = torch.arange(self.lines[0].learners, device=place)
        self.played = Graphed(self.play_here, place)
        self.descended = Graphed(super().descend, place)

    def new_policy(self) -> nn.Module:
        actor = super().new_policy().to(self.worlds.device)
        assert isinstance(actor, ClippedActor)
        actor.new_optimizer(self.recipe.learning_rate.at(1.0))
        return actor

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        episodes = [f"worlds.now.{name}" for name in StoredEpisodes._fields]
        return super()._get_torch_save_params()[0], [*episodes, "worlds.following", "worlds.results.observations"]

    def _update_learning_rate(self, optimizers: Any) -> None:
        """Set the learning rate in the same memory as before, because a CUDA graph reads it there."""
        (group,) = optimizers.param_groups
        rate = group["lr"]
        super()._update_learning_rate(optimizers)
        if isinstance(rate, Tensor):
            group["lr"] = rate.fill_(group["lr"])

    def learn(self, *arguments: Any, **options: Any) -> Self:
        with enough_memory(sizes(self.recipe)):
            return super().learn(*arguments, **options)

    def act(self, observations: Tensor) -> Tensor:
        """Actions of the policy, [n, L] in [-1, 1], for ``observations`` [n, L, F]."""
        outputs: Tensor = self.policy.learning(observations.flatten(0, 1))
        return outputs.clamp(-1.0, 1.0).view(observations.shape[:2])

    @torch.no_grad()
    def collect(self, callback: BaseCallback) -> Tensor:
        """Drive all worlds for ``n_steps`` decisions, whose states ``visited`` then contains.

        Returns the observations of all learners, [D * L, F].
        """
        worlds = self.worlds
        for step in range(self.recipe.n_steps):
            rows = slice(step * worlds.n, (step + 1) * worlds.n)
            for visited, now in zip(self.visited, worlds.now, strict=True):
                visited[..., rows] = now
            self.seen[rows] = worlds.results.observations
            worlds.step(self.act(self.seen[rows]))
        worlds.check()
        self.num_timesteps += self.n_envs * self.recipe.n_steps
        return self.seen.flatten(0, 1)

    def improve(self, visited: Any) -> None:
        """Update the actor with gradients measured at some of the decisions that ``collect`` visited.

        ``visited`` [D * L, F]: observations of L learners at all D visited decisions.
        """
        self.train_actor(self.measure(visited))

    @torch.no_grad()
    def measure(self, observations: Tensor) -> TrialResults:
        """Measured gradients at randomly drawn visited decisions.

        At each, two branches are simulated: one with a higher and one with a lower action than the policy's.
        ``observations`` [D * L, F]: of L learners at all D visited decisions.
        """
        place = self.worlds.device
        (line,) = self.lines
        branches = self.draw_branches(line, np.arange(len(observations)))
        sample = observations[torch.from_numpy(branches.decisions(line.learners)).to(place)]
        gained, moved = self.played(*(torch.from_numpy(column).to(place) for column in branches))
        self.branches.check()
        return TrialResults(sample, self.policy.learning(sample)[:, 0], self.measured_gradient(gained, moved))

    def play_here(self, world: Tensor, learner: Tensor, size: Tensor, steps: Tensor) -> Tensor:
        """Simulate branches: in each, one learner's action is moved for some steps, then the policy continues.

        Returns for each branch the discounted return, and the sum of its actions' moves, [2, 2B]. Actions stay in
        [-1, 1]. Arguments [2B]: visited decision, learner, size of the move, and number of steps for which it lasts.
        """
        worlds, result = self.branches, torch.zeros(2, len(world), dtype=size.dtype, device=size.device)
        observations, mask, discount = worlds.put(self.visited, world), learner[:, None] == self.each_learner, 1.0
        for number in range(self.worlds.longest):
            actions = self.act(observations)
            if number < max(self.recipe.holds):
                held = (number < steps) & (worlds.now.clock[ENDED] == 0.0)
                trial = torch.where(mask & held[:, None], (actions + size[:, None]).clamp(-1.0, 1.0).float(), actions)
                result[1] += (trial.double() - actions.double()).sum(dim=1)
                actions = trial
            result[0] += discount * worlds.step(actions, renew=False).reward
            discount *= self.recipe.gamma
        return result

    def descend(self, observations: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        """Loss of one gradient step of the actor, repeated as a CUDA graph."""
        loss: Tensor = self.descended(observations, target, weight)
        return loss.clone()
