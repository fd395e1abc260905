"""Vine: try a higher and a lower action in the same state; the difference in return is the gradient of the return.

The name is from Schulman et al. 2015 (TRPO), who sample branches from visited states with common random numbers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.learners.branches import Moment, moving, play_on
from ethbrake_marl.extensions.learners.model import BranchingModel
from ethbrake_marl.extensions.learners.networks import Averaged, drawn, linear_layers, perceptron
from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.layers import Float32s


class Actor(Averaged):
    """A deterministic policy: the network's output, clipped to [-1, 1]."""

    def __init__(self, inputs: int, recipe: VineRecipe) -> None:
        shape = recipe.network
        average = perceptron(inputs, 1, shape.policy, shape.activation)
        *hidden, last = linear_layers(average)
        for layer in hidden:
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(last.weight, 0.01)
        nn.init.constant_(last.bias, shape.initial_action or 0.0)
        learning = perceptron(inputs, 1, shape.policy, shape.activation)
        super().__init__(average, learning, recipe.learning_rate.at(1.0))

    @torch.no_grad()
    def means(self, observations: Float32s) -> Float32s:
        """Return the outputs of the network in training, [rows], for observations [rows, F]."""
        means: Float32s = self.learning(torch.from_numpy(observations))[:, 0].numpy()
        return means

    def act(self, observations: Float32s) -> Float32s:
        """Return the actions, [rows]."""
        return np.clip(self.means(observations), -1.0, 1.0)


class Tried(NamedTuple):
    """B decisions at which a higher and a lower action were tried."""

    seen: Float32s  # [B, F] observations
    mean: Float32s  # [B] output of the actor, not clipped
    gradient: Float32s  # [B] of the return with respect to the action


class VineModel(BranchingModel):
    """One actor drives all learners, and learns from measured gradients."""

    policy: Actor
    recipe: VineRecipe

    def new_policy(self) -> nn.Module:
        """Return the actor."""
        return Actor(len(self.features), self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def improve(self, seen: Float32s, states: State) -> None:
        """Measure gradients, and follow them."""
        self.train_actor(self.policy, self.try_out(seen, states, self.policy))

    def try_out(self, seen: Float32s, states: State, policy: Actor) -> Tried:
        """Draw visited decisions; play a branch with a higher and one with a lower action than the policy's."""
        recipe, learners = self.recipe, self.learners
        alive = np.flatnonzero(moving(states).repeat(learners))
        rows = drawn(alive, recipe.tried)
        least, most = recipe.offset.smallest, recipe.offset.largest
        sizes: Floats = least * (most / least) ** torch.rand(len(rows), dtype=torch.float64).numpy()
        world, learner = np.divmod(np.tile(rows, 2), learners)
        size, steps = np.concatenate([sizes, -sizes]), np.tile(self.drawn_steps(len(rows)), 2)
        moved = np.zeros(len(size))  # by how much the actions were moved, after clipping, summed over the steps

        def decide(now: Moment) -> Floats:
            actions = now.ask(policy.act)
            some = np.flatnonzero(now.number < steps[now.rows]) if now.number < longest else steps[:0]
            row = now.rows[some]
            before = actions[some, learner[row]]
            after = np.clip(before + size[row], -1.0, 1.0)
            actions[some, learner[row]] = after
            moved[row] += after - before
            return actions

        longest = int(steps.max(initial=0))
        gained, _ = play_on(self.game, states.take(world), decide, recipe.gamma, at_least=longest)
        (up, down), (higher, lower) = np.split(gained[np.arange(len(size)), learner], 2), np.split(moved, 2)
        measured = (up - down) / (higher - lower)
        gradient = np.clip(measured, -recipe.gradient_limit, recipe.gradient_limit)
        whole = float(np.abs(measured).sum())
        self.logger.record("train/gradient_cut", 1.0 - float(np.abs(gradient).sum()) / whole if whole else 0.0)
        return Tried(seen[rows], policy.means(seen[rows]), gradient.astype(np.float32))

    def train_actor(self, actor: Actor, tried: Tried) -> None:
        """Move an actor's outputs towards their targets."""
        recipe = self.recipe
        self._update_learning_rate(actor.optimizer)
        target, weight = trusted_targets(tried, recipe.trust_radius, recipe.anchor)
        seen, wanted, weights = (torch.from_numpy(array) for array in (tried.seen, target, weight))
        losses = []
        for _ in range(recipe.n_epochs):
            for batch in torch.split(torch.randperm(len(wanted)), recipe.batch_size):
                loss = (weights[batch] * (actor.learning(seen[batch])[:, 0] - wanted[batch]) ** 2).mean()
                losses.append(actor.descend(loss, recipe.averaging))
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)
        self.logger.record("train/gradient", float(np.abs(tried.gradient).mean()) if len(wanted) else 0.0)
        self.logger.record("train/tried", len(wanted))


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Return targets of the actor's outputs, and the weights of the squared errors in the loss, [B] each.

    Let m be the present output and g the gradient. Then ``weight = |g| / radius + anchor`` and ``target = m + g /
    weight``: the target is less than ``radius`` away, and ``(weight / 2) (output - target)^2`` has the slope ``-g`` at
    m. An output at or beyond 1 is not moved farther out, because actions are clipped to [-1, 1].
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
