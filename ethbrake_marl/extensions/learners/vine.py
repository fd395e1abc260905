"""Vine: try a higher and a lower action in the same state; the difference in return is the gradient of the return.

The name is from Schulman et al. 2015 (TRPO), who sample branches from visited states with common random numbers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.learners.branches import Offsets, moving, play_to_the_end
from ethbrake_marl.extensions.learners.model import BranchingModel
from ethbrake_marl.extensions.learners.networks import Averaged, Scout, choose_rows, linear_layers, perceptron
from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.motion.elementary import exp, log
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.layers import Float32s

REMEMBERED = 65_536  # measured gradients from which `gradient_limit: auto` is computed
CUT = 0.1  # share of the sum of gradients that the limit then removes
SPREAD = 2.0  # ratio of the gradients (root mean square) at the smallest offset to those at the largest
NARROWEST = 4.0  # least ratio of the largest offset to the smallest


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
        scout = Scout(inputs) if recipe.focus > 0.0 else None
        super().__init__(average, learning, recipe.learning_rate.at(1.0), scout)

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
    importance: Float32s  # [B] weight in the loss


class VineModel(BranchingModel):
    """One actor drives all learners, and learns from measured gradients."""

    policy: Actor
    recipe: VineRecipe

    def new_policy(self) -> nn.Module:
        """Return the actor, with the memory of measured gradients and their offsets if the limit is automatic."""
        policy = self.new_actors()
        if self.recipe.gradient_limit == "auto":
            policy.register_buffer("measured", torch.zeros(REMEMBERED, 2, dtype=torch.float64))
        return policy

    def new_actors(self) -> nn.Module:
        """Return what drives."""
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
        rows, importance = choose_rows(seen, alive, recipe.tried, recipe.focus, policy.expect)
        least, most, memory = recipe.offset.smallest, recipe.offset.largest, getattr(self.policy, "measured", None)
        if memory is not None:
            least = smallest_offset(memory.numpy(), least, most)
        sizes: Floats = least * (most / least) ** torch.rand(len(rows), dtype=torch.float64).numpy()
        steps = np.tile(self.drawn_steps(len(rows)), 2)
        offsets = Offsets(np.tile(rows % learners, 2), np.concatenate([sizes, -sizes]), steps)
        branches = states.take(np.tile(rows // learners, 2))
        gained, moved = play_to_the_end(self.game, branches, policy.act, offsets, recipe.gamma)
        (up, down), (higher, lower) = np.split(gained, 2), np.split(moved, 2)
        measured = (up - down) / (higher - lower)
        gradient = self.limited(measured, sizes, memory, least)
        return Tried(seen[rows], policy.means(seen[rows]), gradient.astype(np.float32), importance)

    def limited(self, measured: Floats, sizes: Floats, memory: Tensor | None, least: float) -> Floats:
        """Return the gradients within the recipe's limit, and remember them if the limit is automatic."""
        limit = self.recipe.gradient_limit
        if memory is not None:
            new = torch.from_numpy(np.stack([np.abs(measured), sizes], axis=1))
            memory.copy_(torch.cat([memory, new])[-len(memory) :])
            limit = limit_that_cuts(memory[:, 0].numpy(), CUT)
            self.logger.record("train/gradient_limit", limit)
            self.logger.record("train/smallest_offset", least)
        assert limit != "auto"
        gradient = np.clip(measured, -limit, limit)
        whole = float(np.abs(measured).sum())
        self.logger.record("train/gradient_cut", 1.0 - float(np.abs(gradient).sum()) / whole if whole else 0.0)
        return gradient

    def train_actor(self, actor: Actor, tried: Tried) -> None:
        """Move an actor's outputs towards their targets."""
        recipe = self.recipe
        self._update_learning_rate(actor.optimizer)
        target, weight = trusted_targets(tried, recipe.trust_radius, recipe.anchor)
        arrays = (tried.seen, target, weight * tried.importance, np.abs(tried.gradient), tried.importance)
        seen, wanted, weights, sizes, importance = (torch.from_numpy(array) for array in arrays)
        losses = []
        for _ in range(recipe.n_epochs):
            for batch in torch.split(torch.randperm(len(wanted)), recipe.batch_size):
                loss = (weights[batch] * (actor.learning(seen[batch])[:, 0] - wanted[batch]) ** 2).mean()
                scout = [] if actor.scout is None else [actor.scout.loss(seen[batch], sizes[batch], importance[batch])]
                actor.descend(loss, *scout)
                actor.follow(recipe.averaging)
                losses.append(loss.item())
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
    gradient = np.where(outward, np.float32(0.0), tried.gradient)
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    return tried.mean + gradient / weight, weight


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """Return the limit at which clipping ``sizes`` [n] lowers their sum by the fraction ``share``.

    Sizes 1, 1, 4 and the share 1/3 give 2: clipped they are 1, 1, 2, and their sum falls from 6 to 4.
    """
    rising = np.sort(sizes)
    remaining = np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising  # sum if each in turn is the limit
    return float(np.interp((1.0 - share) * remaining[-1], remaining, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """Return the smallest offset with which gradients should be measured, from ``least`` to ``most / NARROWEST``.

    Where harm is smooth, gradients do not depend on the offset, and ``least`` is best. Where it jumps, they grow as the
    offset falls; then the result is the offset at which they are expected to be ``SPREAD`` times as large (in root mean
    square) as at ``most``. ``measured`` [n, 2] has rows (absolute gradient, its offset); offset 0: an empty row. The
    half with the smaller offsets is compared with the other half, on logarithmic scales.
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))
