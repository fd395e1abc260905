"""Rollout classification: try several choices at a decision, and learn to take the cheapest one.

Source: Lagoudakis and Parr, Reinforcement Learning as Classification, 2003.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ethbrake_marl.episode.counts import other_count
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.extensions.learners.branches import Moment, moving, play_on
from ethbrake_marl.extensions.learners.model import BranchingModel
from ethbrake_marl.extensions.learners.networks import Averaged, Memory, drawn, perceptron, silent
from ethbrake_marl.extensions.learners.recipes import RolloutClassificationRecipe
from ethbrake_marl.extensions.learners.start import widened
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.actor import Actor
from ethbrake_marl.policies.layers import Float32s, Layers
from ethbrake_marl.worlds.sampling import member_numbers
from ethbrake_marl.worlds.scenario import Scenario

FOR_GOOD = 2**31  # steps, more than an episode has
USUAL_KEPT = 0.98  # weight of the old value in the running mean of costs
LEAST_USUAL = 0.1  # m2/s2; least divisor of relative costs, for scenarios with almost no harm


class TorchActor(Actor):
    """Actor of a policy file, computed with torch: three times as fast, equal except for rounding."""

    @torch.no_grad()
    def forward(self, layers: Layers, x: Float32s) -> Float32s:
        activation = torch.relu if self.spec.activation == "relu" else torch.tanh
        y: Tensor = torch.from_numpy(x)
        for number, (weight, bias) in enumerate(layers, 1):
            y = torch.addmm(torch.from_numpy(bias)[:, None], torch.from_numpy(weight), y)
            y = y if number == len(layers) else activation(y)
        outputs: Float32s = y.numpy()
        return outputs


class Chooser(Averaged):
    """Network that scores choices and takes the best: first come trained policies, then actions from -1 to 1.

    ``first`` is the number of the first action, full braking. The *extra cost* of a choice is its cost minus the cost
    of the cheapest choice tried at the same decision.
    """

    memory: Memory  # seen [F]; tried [C]: numbers of choices, the chooser's own one first; more [C]: their extra costs
    usual: Tensor  # [scenarios of a mixture] mean cost of the best tried choice; 0: not measured yet

    def __init__(self, features: tuple[str, ...], recipe: RolloutClassificationRecipe, scenarios: int) -> None:
        inputs, shape, self_tried = len(features), recipe.network, 1 + recipe.others
        among = [widened(member, features, recipe.name, "policies") for member in recipe.members]
        spec = recipe.network_spec(inputs)
        average = silent(perceptron(inputs, len(among) + shape.choices, shape.policy, shape.activation))
        super().__init__(average, copy.deepcopy(average), recipe.learning_rate.at(1.0))
        fixed = {f"among_{m}.{name}": each for m, member in enumerate(among, 1) for name, each in member.items()}
        self.first, self.fixed = len(among), fixed
        self.actor = TorchActor(spec, {**self.tensors("policy"), **fixed})
        like = {"tried": torch.zeros(self_tried, dtype=torch.int64), "more": torch.zeros(self_tried)}
        self.memory = Memory(recipe.memory, seen=torch.zeros(inputs), **like)
        self.register_buffer("usual", torch.zeros(scenarios, dtype=torch.float64))

    def take(self, choices: Ints, observations: Float32s) -> Float32s:
        actions: Float32s = self.actor.chosen(choices, observations.T)[0]
        return actions

    def act(self, observations: Float32s) -> Float32s:
        return self.take(self.best(observations), observations)

    def draw(self, batches: int, count: int, focus: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Draw ``count`` stored decisions for each gradient step: yield their numbers and importances, [count] each.

        The share ``focus`` is drawn in proportion to the largest extra cost, the others uniformly. The importance of a
        decision is ``1 / (n p)``, with the probability p of drawing it from n, so the mean of the loss stays the same.
        """
        known = len(self.memory)
        if focus == 0.0:
            for _ in range(batches):
                yield torch.randint(known, (count,)), torch.ones(count)
            return
        most = self.memory.get_buffer("more")[:known].max(dim=1).values.numpy()
        chance = (1.0 - focus) / known + focus * (most / most.sum())
        rows = torch.multinomial(torch.from_numpy(chance), batches * count, replacement=True)
        importance = torch.from_numpy((1.0 / (known * chance[rows.numpy()])).astype(np.float32))
        yield from zip(rows.view(batches, count), importance.view(batches, count), strict=True)

    def loss(self, some: Tensor, importance: Tensor, guide: float) -> Tensor:
        """Return the loss at stored decisions: the expected extra cost of a choice, plus ``guide`` times a convex term.

        A choice has the probability softmax of the scores. Where a probability is close to 0 or 1, the gradient of the
        expected cost nearly vanishes, but the convex term's does not: it lowers the score of every tried choice but the
        cheapest, in proportion to its extra cost.
        """
        seen, tried, more = (self.memory.get_buffer(name)[some] for name in ("seen", "tried", "more"))
        scores = self.learning(seen).gather(1, tried)
        best = scores.gather(1, more.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * more).sum(dim=1)
        loss: Tensor = (importance * (expected + guide * (more * softplus(scores - best)).sum(dim=1))).mean()
        return loss

    def all_tensors(self) -> dict[str, Float32s]:
        return self.tensors("policy") | self.fixed


class RolloutClassificationModel(BranchingModel):
    policy: Chooser
    recipe: RolloutClassificationRecipe

    def new_policy(self) -> nn.Module:
        """Return a network that takes choice 0 at first: the first policy or, without policies, full braking."""
        return Chooser(self.features, self.recipe, len(self.scenario.members) or 1)

    @property
    def scenario(self) -> Scenario:
        return self.rows.scenario

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
        for some, importance in chooser.draw(recipe.gradient_steps, recipe.batch_size, recipe.focus):
            losses.append(chooser.descend(chooser.loss(some, importance, recipe.guide), recipe.averaging).item())
        self._n_updates += len(losses)
        self.logger.record("train/loss", float(np.mean(losses)))

    def choices_at(self, seen: Float32s) -> Ints:
        """Return the choices to try for observations ``seen`` [B, F], [B, C]; the network's own one first."""
        recipe, chooser = self.recipe, self.policy
        first, last, count = chooser.first, recipe.network.choices - 1, len(seen)
        own = chooser.best(seen)
        at = np.rint((chooser.take(own, seen) + 1.0) * last / 2.0).astype(np.int64)
        tried = [own]
        for near in recipe.near:
            ratio = (near.largest / near.smallest) ** torch.rand(count, dtype=torch.float64).numpy()
            far = np.maximum(np.rint(near.smallest * ratio * last / 2.0).astype(np.int64), 1)
            tried += [first + np.clip(at - far, 0, last), first + np.clip(at + far, 0, last)]
        tried += [np.full(count, first + round((action + 1.0) * last / 2.0)) for action in recipe.fixed]
        if first:
            tried += [*torch.rand(count, first).argsort(dim=1)[:, : recipe.drawn].T.numpy()]
        else:
            tried += [torch.randint(last + 1, (count,)).numpy() for _ in range(recipe.drawn)]
        return np.stack(tried, axis=1)

    def try_choices(self, seen: Float32s, states: State) -> tuple[Ints, Ints, Floats]:
        """Try C choices at B visited decisions, each in a branch that is simulated to the end.

        Returns the numbers of the decisions, [B], the choices, [B, C], and their costs, [B, C]: minus the return,
        changed by the recipe's keys ``tie_break``, ``caution`` and ``relative``.
        """
        recipe, chooser, learners = self.recipe, self.policy, self.learners
        alive = np.flatnonzero(moving(states).repeat(learners))
        rows = drawn(alive, recipe.tried)
        tried = self.choices_at(seen[rows])
        every, steps_of = chooser.first + recipe.network.choices, self.drawn_steps(len(rows))
        pairs, back = np.unique(np.arange(len(rows))[:, np.newaxis] * every + tried, return_inverse=True)
        decision, choice = np.divmod(pairs, every)
        steps = steps_of[decision]
        if recipe.caution:  # one more branch of each decision brakes fully to the end
            decision = np.append(decision, np.arange(len(rows)))
            choice = np.append(choice, np.full(len(rows), chooser.first))
            steps = np.append(steps, np.full(len(rows), FOR_GOOD))
        learner, each = rows[decision] % learners, np.arange(len(decision))

        def decide(now: Moment) -> Floats:
            flat = now.seen.reshape(-1, now.seen.shape[2])
            choices, held = chooser.best(flat), np.flatnonzero(now.number < steps[now.rows])
            whose = now.rows[held]
            choices[held * learners + learner[whose]] = choice[whose]
            return chooser.take(choices, flat).astype(np.float64).reshape(now.seen.shape[:2])

        branches = states.take(rows[decision] // learners)
        gained, last = play_on(self.game, branches, decide, recipe.gamma, at_least=max(recipe.holds))
        cost = -gained[each, learner]
        if recipe.tie_break:
            other = other_count(recipe.reward.harm_count)
            cost += recipe.tie_break * (self.harm(last, other) - self.harm(branches, other))[each, learner]
        costs = cost[back].reshape(tried.shape)
        if recipe.caution:
            done = 1.0 - self._current_progress_remaining
            costs += recipe.caution * done * np.maximum(costs - cost[len(pairs) :, np.newaxis], 0.0)
        if recipe.relative and len(rows):
            numbers = states.clock[rows // learners, NUMBER].astype(np.int64)
            costs /= self.usual_costs(numbers, costs.min(axis=1))[:, np.newaxis]
        return rows, tried, costs

    def usual_costs(self, numbers: Ints, least: Floats) -> Floats:
        """Update each scenario's running mean of the least cost; return it for each decision, [B].

        ``numbers`` [B]: numbers of the worlds, which decide the scenario in a mixture. ``least`` [B]: costs of the
        cheapest choices.
        """
        known, back = np.unique(numbers, return_inverse=True)
        member = member_numbers(self.scenario, known, self.recipe.seed, "training")[back]
        usual = self.policy.usual.numpy()
        for m in np.unique(member):
            mean = float(least[member == m].mean())
            usual[m] = USUAL_KEPT * usual[m] + (1.0 - USUAL_KEPT) * mean if usual[m] else mean
        return np.asarray(np.maximum(usual[member], LEAST_USUAL))
