"""Rollout classification: try several choices at a decision, and learn to take the cheapest one.

Source: Lagoudakis and Parr, Reinforcement Learning as Classification, 2003.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.learners.branches import Moment, moving, play_on
from ethbrake_marl.extensions.learners.model import BranchingModel, Line, Visited
from ethbrake_marl.extensions.learners.networks import (
    AveragedNetwork,
    ReplayBuffer,
    draw_rows,
    perceptron,
    zero_last_layer,
)
from ethbrake_marl.extensions.learners.recipes import RolloutClassificationRecipe
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.layers import Float32s

FOR_GOOD = 2**31  # steps, more than an episode has


class ChoiceBranches(NamedTuple):
    """M simulations from B decisions to the end. A choice is held first; afterwards the network decides."""

    decision: Ints  # [M] 0 to B - 1
    choice: Ints  # [M] number of an action of the network
    steps: Ints  # [M] for which the choice is held

    @classmethod
    def of(cls, candidates: Ints, steps: Ints, choices: int) -> tuple[ChoiceBranches, Ints]:
        """One branch for each different choice at each decision; and the index of each candidate's branch, [B, C].

        ``candidates`` [B, C]: choices to try at B decisions, numbers below ``choices``, held for ``steps`` [B].
        """
        pairs, back = np.unique(np.arange(len(candidates))[:, np.newaxis] * choices + candidates, return_inverse=True)
        decision, choice = np.divmod(pairs, choices)
        return cls(decision, choice, steps[decision]), back.reshape(candidates.shape)

    def with_full_braking(self, decisions: int) -> ChoiceBranches:
        """These branches, followed by one branch for each decision in which the learner brakes fully to the end."""
        braking = np.arange(decisions), np.zeros(decisions, np.int64), np.full(decisions, FOR_GOOD)
        return ChoiceBranches(*(np.append(*parts) for parts in zip(self, braking, strict=True)))


class Chooser(AveragedNetwork):
    """Network that scores actions from -1, full braking, to 1, and takes the best.

    The *extra cost* of a choice is its cost minus the cost of the cheapest choice tried at the same decision.
    """

    memory: ReplayBuffer  # seen [F]; tried [C]: numbers of choices, the chooser's first; more [C]: their extra costs

    def __init__(self, inputs: int, recipe: RolloutClassificationRecipe) -> None:
        shape, tried_count = recipe.network, 1 + recipe.others
        average = zero_last_layer(perceptron(inputs, shape.choices, shape.policy, shape.activation))
        super().__init__(average, copy.deepcopy(average), recipe.learning_rate.at(1.0))
        self.actions = recipe.network_spec(inputs).actions
        columns = {"tried": torch.zeros(tried_count, dtype=torch.int64), "more": torch.zeros(tried_count)}
        self.memory = ReplayBuffer(recipe.memory, seen=torch.zeros(inputs), **columns)

    def act(self, observations: Float32s) -> Float32s:
        return self.actions[self.best(observations)]

    def loss(self, slots: Tensor, guide: float) -> Tensor:
        """Loss at ``slots`` stored decisions: the expected extra cost, plus ``guide`` times a convex term.

        A choice has the probability softmax of the scores. Where a probability is close to 0 or 1, the gradient of the
        expected cost nearly vanishes, but the convex term's does not: it lowers the score of every tried choice but the
        cheapest, in proportion to its extra cost.
        """
        observations, choices, extra_costs = (self.memory.get_buffer(name)[slots] for name in ("seen", "tried", "more"))
        scores = self.learning(observations).gather(1, choices)
        best = scores.gather(1, extra_costs.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * extra_costs).sum(dim=1)
        loss: Tensor = (expected + guide * (extra_costs * softplus(scores - best)).sum(dim=1)).mean()
        return loss


class RolloutClassificationModel(BranchingModel):
    policy: Chooser
    recipe: RolloutClassificationRecipe

    def new_policy(self) -> nn.Module:
        """Network whose choice is 0, full braking, before any training."""
        return Chooser(len(self.features), self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def improve(self, visited: Sequence[Visited]) -> None:
        """Try choices at visited decisions, store their extra costs, and train the network on stored decisions."""
        recipe, chooser = self.recipe, self.policy
        (decisions,) = visited
        observations = decisions.observations
        self._update_learning_rate(chooser.optimizer)
        rows, choices, costs = self.try_choices(decisions)
        extra_costs = costs - costs.min(axis=1, keepdims=True)
        differ = np.flatnonzero(extra_costs.max(axis=1) > 1e-9)
        extra_costs = np.minimum(extra_costs, recipe.largest_cost)
        chooser.memory.store(
            seen=observations[rows[differ]], tried=choices[differ], more=extra_costs[differ].astype(np.float32)
        )
        self.logger.record("train/regret", float(extra_costs[:, 0].mean()) if len(extra_costs) else 0.0)
        self.logger.record("train/differ", len(differ))
        losses = []
        if not len(chooser.memory):
            return
        for _ in range(recipe.gradient_steps):
            slots = torch.randint(len(chooser.memory), (recipe.batch_size,))
            losses.append(chooser.descend(chooser.loss(slots, recipe.guide), recipe.averaging).item())
        self._n_updates += len(losses)
        self.logger.record("train/loss", float(np.mean(losses)))

    def choices_at(self, observations: Float32s) -> Ints:
        """Choices to try at B decisions with the observations [B, F]: [B, C], the network's choice first."""
        recipe, last, count = self.recipe, self.recipe.network.choices - 1, len(observations)
        best_choices = self.policy.best(observations)
        choices = [best_choices]
        for near in recipe.near:
            ratio = (near.largest / near.smallest) ** torch.rand(count, dtype=torch.float64).numpy()
            far = np.maximum(np.rint(near.smallest * ratio * last / 2.0).astype(np.int64), 1)
            choices += [np.clip(best_choices - far, 0, last), np.clip(best_choices + far, 0, last)]
        choices += [np.full(count, round((action + 1.0) * last / 2.0)) for action in recipe.fixed]
        choices += [torch.randint(last + 1, (count,)).numpy() for _ in range(recipe.drawn)]
        return np.stack(choices, axis=1)

    def try_choices(self, visited: Visited) -> tuple[Ints, Ints, Floats]:
        """Try C choices at B visited decisions, each in a branch that is simulated to the end.

        Returns the indices of the decisions, [B], the choices, [B, C], and their costs, [B, C]: minus the return, plus
        the further cost of the recipe's key ``caution``.
        """
        recipe, (line, observations, states) = self.recipe, visited
        rows = draw_rows(np.flatnonzero(moving(states).repeat(line.learners)), recipe.tried)
        tried_choices = self.choices_at(observations[rows])
        branches, branch = ChoiceBranches.of(tried_choices, self.drawn_steps(len(rows)), recipe.network.choices)
        if not recipe.caution:
            return rows, tried_choices, self.costs_of(line, states, rows, branches)[branch]
        cost = self.costs_of(line, states, rows, branches.with_full_braking(len(rows)))
        costs, of_braking = cost[branch], cost[len(branches.choice) :, np.newaxis]
        progress = 1.0 - self._current_progress_remaining
        costs += recipe.caution * progress * np.maximum(costs - of_braking, 0.0)
        return rows, tried_choices, costs

    def costs_of(self, line: Line, states: State, rows: Ints, branches: ChoiceBranches) -> Floats:
        """Cost of each branch, [M]: minus the return of the learner whose choice is tried.

        ``rows`` [B]: indices of the decisions among all visited ones.
        """
        chooser, learners = self.policy, line.learners
        world, learner = np.divmod(rows[branches.decision], learners)

        def decide(now: Moment) -> Floats:
            flat = now.seen.reshape(-1, now.seen.shape[2])
            choices, held = chooser.best(flat), np.flatnonzero(now.number < branches.steps[now.rows])
            branch = now.rows[held]
            choices[held * learners + learner[branch]] = branches.choice[branch]
            return chooser.actions[choices].astype(np.float64).reshape(now.seen.shape[:2])

        gained, _ = play_on(line.game, states.take(world), decide, self.recipe.gamma, at_least=max(self.recipe.holds))
        return -gained[np.arange(len(world)), learner]
