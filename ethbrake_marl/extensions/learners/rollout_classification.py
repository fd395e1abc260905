"""Rollout classification: try several choices at a decision, and learn to take the cheapest one.

Source: Lagoudakis and Parr, Reinforcement Learning as Classification, 2003.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.learners.branches import Moment, moving, play_on
from ethbrake_marl.extensions.learners.model import BranchingModel
from ethbrake_marl.extensions.learners.networks import Averaged, Memory, drawn, perceptron, silent
from ethbrake_marl.extensions.learners.recipes import RolloutClassificationRecipe
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.layers import Float32s

FOR_GOOD = 2**31  # steps, more than an episode has


class Branches(NamedTuple):
    """Simulations to the end, [M]: each begins at a decision with a choice, and leaves the rest to the network."""

    decision: Ints  # 0 to B - 1
    choice: Ints
    steps: Ints  # for which the choice is held

    @classmethod
    def of(cls, tried: Ints, steps: Ints, choices: int) -> tuple[Branches, Ints]:
        """One branch for each different choice of a decision, and the branches of ``tried``, [B, C].

        ``tried`` [B, C] are numbers below ``choices``; those of a decision are held for ``steps`` [B].
        """
        pairs, back = np.unique(np.arange(len(tried))[:, np.newaxis] * choices + tried, return_inverse=True)
        decision, choice = np.divmod(pairs, choices)
        return cls(decision, choice, steps[decision]), back.reshape(tried.shape)

    def with_full_braking(self, decisions: int) -> Branches:
        """These branches, and then one for each of the decisions that brakes fully to the end."""
        braking = np.arange(decisions), np.zeros(decisions, np.int64), np.full(decisions, FOR_GOOD)
        return Branches(*(np.append(*parts) for parts in zip(self, braking, strict=True)))


class Chooser(Averaged):
    """Network that scores actions from -1, full braking, to 1, and takes the best.

    The *extra cost* of a choice is its cost minus the cost of the cheapest choice tried at the same decision.
    """

    memory: Memory  # seen [F]; tried [C]: numbers of choices, the chooser's own one first; more [C]: their extra costs

    def __init__(self, inputs: int, recipe: RolloutClassificationRecipe) -> None:
        shape, self_tried = recipe.network, 1 + recipe.others
        average = silent(perceptron(inputs, shape.choices, shape.policy, shape.activation))
        super().__init__(average, copy.deepcopy(average), recipe.learning_rate.at(1.0))
        self.actions = recipe.network_spec(inputs).actions
        like = {"tried": torch.zeros(self_tried, dtype=torch.int64), "more": torch.zeros(self_tried)}
        self.memory = Memory(recipe.memory, seen=torch.zeros(inputs), **like)

    def act(self, observations: Float32s) -> Float32s:
        return self.actions[self.best(observations)]

    def loss(self, some: Tensor, guide: float) -> Tensor:
        """Loss at ``some`` stored decisions: the expected extra cost, plus ``guide`` times a convex term.

        A choice has the probability softmax of the scores. Where a probability is close to 0 or 1, the gradient of the
        expected cost nearly vanishes, but the convex term's does not: it lowers the score of every tried choice but the
        cheapest, in proportion to its extra cost.
        """
        seen, tried, more = (self.memory.get_buffer(name)[some] for name in ("seen", "tried", "more"))
        scores = self.learning(seen).gather(1, tried)
        best = scores.gather(1, more.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * more).sum(dim=1)
        loss: Tensor = (expected + guide * (more * softplus(scores - best)).sum(dim=1)).mean()
        return loss


class RolloutClassificationModel(BranchingModel):
    policy: Chooser
    recipe: RolloutClassificationRecipe

    def new_policy(self) -> nn.Module:
        """Network that takes choice 0 at first, full braking."""
        return Chooser(len(self.features), self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def improve(self, seen: Float32s, states: State) -> None:
        recipe, chooser = self.recipe, self.policy
        self._update_learning_rate(chooser.optimizer)
        rows, tried, costs = self.try_choices(seen, states)
        more = costs - costs.min(axis=1, keepdims=True)
        differ = np.flatnonzero(more.max(axis=1) > 1e-9)
        more = np.minimum(more, recipe.largest_cost)
        chooser.memory.store(seen=seen[rows[differ]], tried=tried[differ], more=more[differ].astype(np.float32))
        self.logger.record("train/regret", float(more[:, 0].mean()) if len(more) else 0.0)
        self.logger.record("train/differ", len(differ))
        losses = []
        if not len(chooser.memory):
            return
        for _ in range(recipe.gradient_steps):
            some = torch.randint(len(chooser.memory), (recipe.batch_size,))
            losses.append(chooser.descend(chooser.loss(some, recipe.guide), recipe.averaging).item())
        self._n_updates += len(losses)
        self.logger.record("train/loss", float(np.mean(losses)))

    def choices_at(self, seen: Float32s) -> Ints:
        """Choices to try for observations ``seen`` [B, F], [B, C]; the network's own one first."""
        recipe, last, count = self.recipe, self.recipe.network.choices - 1, len(seen)
        own = self.policy.best(seen)
        tried = [own]
        for near in recipe.near:
            ratio = (near.largest / near.smallest) ** torch.rand(count, dtype=torch.float64).numpy()
            far = np.maximum(np.rint(near.smallest * ratio * last / 2.0).astype(np.int64), 1)
            tried += [np.clip(own - far, 0, last), np.clip(own + far, 0, last)]
        tried += [np.full(count, round((action + 1.0) * last / 2.0)) for action in recipe.fixed]
        tried += [torch.randint(last + 1, (count,)).numpy() for _ in range(recipe.drawn)]
        return np.stack(tried, axis=1)

    def try_choices(self, seen: Float32s, states: State) -> tuple[Ints, Ints, Floats]:
        """Try C choices at B visited decisions, each in a branch that is simulated to the end.

        Returns the numbers of the decisions, [B], the choices, [B, C], and their costs, [B, C]: minus the return,
        changed by the recipe's key ``caution``.
        """
        recipe = self.recipe
        rows = drawn(np.flatnonzero(moving(states).repeat(self.learners)), recipe.tried)
        tried = self.choices_at(seen[rows])
        branches, branch = Branches.of(tried, self.drawn_steps(len(rows)), recipe.network.choices)
        if not recipe.caution:
            return rows, tried, self.costs_of(states, rows, branches)[branch]
        cost = self.costs_of(states, rows, branches.with_full_braking(len(rows)))
        costs, of_braking = cost[branch], cost[len(branches.choice) :, np.newaxis]
        done = 1.0 - self._current_progress_remaining
        costs += recipe.caution * done * np.maximum(costs - of_braking, 0.0)
        return rows, tried, costs

    def costs_of(self, states: State, rows: Ints, branches: Branches) -> Floats:
        """Cost of each branch, [M]: minus the return of the learner that decides. ``rows`` [B]: its decisions."""
        chooser, learners = self.policy, self.learners
        world, learner = np.divmod(rows[branches.decision], learners)

        def decide(now: Moment) -> Floats:
            flat = now.seen.reshape(-1, now.seen.shape[2])
            choices, held = chooser.best(flat), np.flatnonzero(now.number < branches.steps[now.rows])
            whose = now.rows[held]
            choices[held * learners + learner[whose]] = branches.choice[whose]
            return chooser.actions[choices].astype(np.float64).reshape(now.seen.shape[:2])

        gained, _ = play_on(self.game, states.take(world), decide, self.recipe.gamma, at_least=max(self.recipe.holds))
        return -gained[np.arange(len(world)), learner]
