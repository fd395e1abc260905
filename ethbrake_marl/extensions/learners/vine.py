"""Vine: try a higher and a lower action in the same state; the difference in return is the gradient of the return.

The name is from Schulman et al. 2015 (TRPO), who sample branches from visited states with common random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.learners.branches import Moment, moving, play_on
from ethbrake_marl.extensions.learners.model import BranchingModel, Line, Visited
from ethbrake_marl.extensions.learners.networks import AveragedNetwork, draw_rows, linear_layers, perceptron
from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.layers import Float32s


class ClippedActor(AveragedNetwork):
    """A deterministic policy: the network's output, clipped to [-1, 1].

    ``features``: names of the observed features. Raises ``InvalidInput`` if they lack the one that the recipe's key
    ``network.initial_action`` names.
    """

    def __init__(self, features: Sequence[str], recipe: VineRecipe) -> None:
        shape = recipe.network
        average = perceptron(len(features), 1, shape.policy, shape.activation)
        *hidden, last = linear_layers(average)
        for layer in hidden:
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
            nn.init.zeros_(layer.bias)
        if isinstance(shape.initial_action, str):
            if shape.initial_action not in features:
                raise InvalidInput(
                    f"recipe {recipe.name!r}: the observation lacks the feature {shape.initial_action}, which"
                    " network.initial_action names; add it to the observation"
                )
            pass_through(hidden, last, features.index(shape.initial_action))
        else:
            nn.init.orthogonal_(last.weight, 0.01)
            nn.init.constant_(last.bias, shape.initial_action or 0.0)
        learning = perceptron(len(features), 1, shape.policy, shape.activation)
        super().__init__(average, learning, recipe.learning_rate.at(1.0))

    @torch.no_grad()
    def means(self, observations: Float32s) -> Float32s:
        """Outputs of the network in training (not of its average), [rows], for observations [rows, F]."""
        means: Float32s = self.learning(torch.from_numpy(observations))[:, 0].numpy()
        return means

    def act(self, observations: Float32s) -> Float32s:
        return np.clip(self.means(observations), -1.0, 1.0)


@torch.no_grad()
def pass_through(hidden: Sequence[nn.Linear], last: nn.Linear, column: int) -> None:
    """Set weights of a relu network so that its output is exactly the input x in this ``column``.

    The first two units of every hidden layer are max(x, 0) and max(-x, 0), and the output is their difference. The
    weights of the other hidden units stay, but those of the output for these units are 0.
    """
    first, *between = hidden
    first.weight[:2] = 0.0
    first.weight[:2, column] = torch.tensor([1.0, -1.0])
    for layer in between:
        layer.weight[:2] = torch.eye(2, layer.in_features)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    last.weight[0, :2] = torch.tensor([1.0, -1.0])


class Branches(NamedTuple):
    """Two simulated branches of each of B visited decisions: first B with a higher action, then B with a lower one."""

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


class VineModel(BranchingModel):
    policy: ClippedActor
    recipe: VineRecipe

    def new_policy(self) -> nn.Module:
        return ClippedActor(self.features, self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def improve(self, visited: Sequence[Visited]) -> None:
        results = [self.try_out(decisions) for decisions in visited]
        self.train_actor(TrialResults(*(torch.cat(parts) for parts in zip(*results, strict=True))))

    def try_out(self, visited: Visited) -> TrialResults:
        """Results at random visited decisions, simulated with a higher and with a lower action than the policy's."""
        line, observations, states = visited
        branches = self.draw_branches(line, np.flatnonzero(moving(states).repeat(line.learners)))
        gained, moved = self.play(line.game, states, branches)
        sample = observations[branches.decisions(line.learners)]
        gradient = self.measured_gradient(torch.from_numpy(gained / line.cost), torch.from_numpy(moved))
        return TrialResults(torch.from_numpy(sample), torch.from_numpy(self.policy.means(sample)), gradient)

    def draw_branches(self, line: Line, decisions: Ints) -> Branches:
        rows, offset = draw_rows(decisions, line.tried), self.recipe.offset
        ratio = offset.largest / offset.smallest
        sizes: Floats = offset.smallest * ratio ** torch.rand(len(rows), dtype=torch.float64).numpy()
        world, learner = np.divmod(np.tile(rows, 2), line.learners)
        return Branches(world, learner, np.concatenate([sizes, -sizes]), np.tile(self.drawn_steps(len(rows)), 2))

    def play(self, game: Game, states: State, branches: Branches) -> tuple[Floats, Floats]:
        """Discounted return of each branch's learner, and how far its actions were moved, [2B] each.

        An action stays in [-1, 1], so it may move by less than ``size``. Moves are summed over the steps.
        """
        world, learner, size, steps = branches
        moved, longest = np.zeros(len(size)), int(steps.max(initial=0))

        def decide(now: Moment) -> Floats:
            actions = now.ask(self.policy.act)
            held = np.flatnonzero(now.number < steps[now.rows]) if now.number < longest else steps[:0]
            row = now.rows[held]
            before = actions[held, learner[row]]
            after = np.clip(before + size[row], -1.0, 1.0)
            actions[held, learner[row]] = after
            moved[row] += after - before
            return actions

        gained, _ = play_on(game, states.take(world), decide, self.recipe.gamma, at_least=longest)
        return gained[np.arange(len(size)), learner], moved

    def measured_gradient(self, gained: Tensor, moved: Tensor) -> Tensor:
        """Gradient of the return at each decision, [B] float32, limited to the recipe's ``gradient_limit``.

        ``gained``, ``moved`` [2B]: return of each branch, and how far its actions were moved.
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
            for batch in torch.split(torch.randperm(len(results.seen)).to(results.seen.device), recipe.batch_size):
                losses.append(self.descend(*(part[batch] for part in lesson)))
        self._n_updates += recipe.n_epochs
        self.logger.record("train/loss", float(np.mean([loss.item() for loss in losses])) if losses else 0.0)
        self.logger.record("train/gradient", float(results.gradient.abs().mean()) if losses else 0.0)
        self.logger.record("train/tried", len(results.seen))

    def descend(self, observations: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        loss = (weight * (self.policy.learning(observations)[:, 0] - target) ** 2).mean()
        return self.policy.descend(loss, self.recipe.averaging)


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
