"""Model of rollout classification: it tries several actions at a decision, and learns which one has the least cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from ethbrake_marl.extensions.learners.branches import counted_harm, moving_rows, other_count, play_on
from ethbrake_marl.extensions.learners.optimizer import descend, follow
from ethbrake_marl.extensions.learners.rollout_classification_actor import ChoosingActor
from ethbrake_marl.extensions.learners.rollout_classification_recipe import RolloutClassificationRecipe
from ethbrake_marl.extensions.learners.vine_model import VineModel
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.policies.network_spec import Float32s
from ethbrake_marl.first_edition.scenario.sampling import members_of
from ethbrake_marl.first_edition.scenario.schema import as_scenario

FOR_GOOD = 2**31  # number of steps beyond the length of any episode

USUAL_KEPT = 0.98  # weight of the old value when the running mean of costs is updated

LEAST_USUAL = 0.1  # m2/s2; least divisor of relative costs, for scenarios with almost no harm


class RolloutClassificationModel(VineModel):
    """Model that drives with an actor, tries several actions at some decisions, and learns from their costs.

    Args:
        environment: environment in which the model is trained.
        recipe: recipe of the training run.
        policies: for each trained policy that the actor can choose, a mapping from names to weights.

    """

    policy: ChoosingActor  # type: ignore[assignment]
    recipe: RolloutClassificationRecipe  # type: ignore[assignment]

    def __init__(
        self,
        environment: EthBrakeVecEnv,
        recipe: RolloutClassificationRecipe,
        policies: Sequence[Mapping[str, Float32s]],
    ) -> None:
        self._policies = policies
        super().__init__(environment, recipe)  # type: ignore[arg-type]  # the recipe has all keys of the base class

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        members = len(as_scenario(self.engine.scenario).members) or 1
        self.policy = ChoosingActor(
            self.observation_space, self.action_space, self.lr_schedule, self.recipe, self._policies, members
        )

    def _update(self, callback: BaseCallback, total: int) -> None:
        recipe, actor = self.recipe, self.policy
        seen, moments = self._visit(callback, actor.act)
        callback.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._update_learning_rate(actor.optimizer)
        observed, tried, costs = self._try_actions(seen, moments)
        more = costs - costs.min(axis=1, keepdims=True)
        differ = np.flatnonzero(more.max(axis=1) > 1e-9)  # decisions at which the choice matters
        more = np.minimum(more, recipe.largest_cost)
        actor.remember(observed[differ], tried[differ], more[differ])
        self.logger.record("train/regret", float(more[:, 0].mean()) if len(more) else 0.0)
        self.logger.record("train/differ", len(differ))
        losses = []
        steps = recipe.gradient_steps if int(actor.known) else 0
        for some, importance in actor.draw(steps, recipe.batch_size, recipe.focus):
            loss = actor.loss(some, importance, recipe.guide)
            descend(actor.optimizer, loss)
            follow(actor.average.parameters(), actor.learning, recipe.averaging)
            losses.append(loss.item())
        self._n_updates += len(losses)
        self.logger.record("train/loss", float(np.mean(losses)) if losses else 0.0)

    def _try_actions(self, seen: Float32s, moments: State) -> tuple[Float32s, Ints, Floats]:
        """Try C choices at each of B visited decisions: simulate the episode to its end after each choice.

        ``seen`` [steps, rows, F] are the observations at the visited decisions, and ``moments`` the states of the
        worlds. Returns the observations [B, F], the numbers of the choices [B, C] (numbered as in ``ChoosingActor``),
        and their costs [B, C]. Column 0 is the actor's own choice. The cost of a choice is minus the return from the
        decision on; the recipe's keys ``tie_break``, ``caution`` and ``relative`` modify this cost.
        """
        recipe, actor, learners = self.recipe, self.policy, len(self.engine.learners)
        observed, first, last = seen.reshape(-1, seen.shape[2]), actor.first, recipe.network.choices - 1
        moving = np.flatnonzero(moving_rows(moments).repeat(learners))
        rows = moving[torch.randperm(len(moving))[: recipe.tried].numpy()]
        taken = actor.choose(observed[rows])
        at = np.rint((actor.take(taken, observed[rows].T)[0] + 1.0) * last / 2.0).astype(np.int64)
        numbers = [taken]
        for near in recipe.near:
            ratio = (near.largest / near.smallest) ** torch.rand(len(rows), dtype=torch.float64).numpy()
            far = np.maximum(np.rint(near.smallest * ratio * last / 2.0).astype(np.int64), 1)
            numbers += [first + np.clip(at - far, 0, last), first + np.clip(at + far, 0, last)]
        numbers += [np.full(len(rows), first + round((action + 1.0) * last / 2.0)) for action in recipe.fixed]
        if first:
            numbers += [*torch.rand(len(rows), first).argsort(dim=1)[:, : recipe.drawn].T.numpy()]
        else:
            numbers += [torch.randint(last + 1, (len(rows),)).numpy() for _ in range(recipe.drawn)]
        tried, every = np.stack(numbers, axis=1), first + last + 1
        holds = np.array(recipe.holds, np.int64)[torch.randint(len(recipe.holds), (len(rows),)).numpy()]
        each, back = np.unique(np.arange(len(rows))[:, None] * every + tried, return_inverse=True)
        row, number = each // every, each % every
        steps = holds[row]
        if recipe.caution:  # one more branch of each decision brakes fully to the end
            row, number = np.append(row, np.arange(len(rows))), np.append(number, np.full(len(rows), first))
            steps = np.append(steps, np.full(len(rows), FOR_GOOD))
        learner = rows[row] % learners

        def decide(now: Observations, some: Ints, done: int) -> Floats:
            flat, held = now.reshape(-1, now.shape[2]), np.flatnonzero(done < steps[some])
            chosen = np.full(len(flat), -1)
            chosen[held * learners + learner[some[held]]] = number[some[held]]
            free = np.flatnonzero(chosen < 0)
            chosen[free] = actor.choose(flat[free])
            wanted: Floats = actor.take(chosen, flat.T)[0].astype(np.float64)
            return wanted.reshape(now.shape[:2])

        engine = self.engine.branch(moments.take(rows[row] // learners))
        other = other_count(engine.reward.harm_count)
        before = counted_harm(engine, other)
        gained = play_on(engine, decide, recipe.gamma, at_least=max(recipe.holds))
        cost = -gained[np.arange(len(row)), learner]
        if recipe.tie_break:
            cost += recipe.tie_break * (counted_harm(engine, other) - before)[np.arange(len(row)), learner]
        costs = cost[back].reshape(tried.shape)
        if recipe.caution:
            done = 1.0 - self._current_progress_remaining
            costs += recipe.caution * done * np.maximum(costs - cost[len(each) :, np.newaxis], 0.0)
        good = np.isfinite(costs).all(axis=1)
        rows, tried, costs = rows[good], tried[good], costs[good]
        if recipe.relative and len(rows):
            costs /= self._usual(rows // learners, costs.min(axis=1))[:, np.newaxis]
        return observed[rows], tried, costs

    def _usual(self, rows: Ints, least: Floats) -> Floats:
        """Update the running mean of the least cost in each scenario of a mixture; return each decision's mean, [B].

        A running mean below ``LEAST_USUAL`` is returned as ``LEAST_USUAL``, because costs are divided by the result.
        ``rows`` [B] are the indices of the visited states in which the decisions were made; ``least`` [B] is the cost
        of the cheapest tried choice.
        """
        numbers = self._numbers[rows]
        first = int(numbers.min())
        drawn = members_of(
            as_scenario(self.engine.scenario),
            int(numbers.max()) - first + 1,
            self.engine.seed,
            first=first,
            channel="training",
        )
        member, usual = drawn[numbers - first], self.policy.usual.numpy()
        for m in np.unique(member):
            mean = float(least[member == m].mean())
            usual[m] = USUAL_KEPT * usual[m] + (1.0 - USUAL_KEPT) * mean if usual[m] else mean
        divisors: Floats = np.maximum(usual[member], LEAST_USUAL)
        return divisors
