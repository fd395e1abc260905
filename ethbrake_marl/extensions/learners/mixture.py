"""A mixture of experts, trained by vine: several actors, and a gating network that chooses one at every decision.

The training has three stages. The first expert is trained in all worlds. Each other expert imitates *templates*, random
braking profiles that do better than all earlier experts, and is then trained where it is not much worse than they are.
At last the gating network learns which expert costs least.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn
from torch.nn.functional import mse_loss, softplus

from ethbrake_marl.episode.counts import other_count
from ethbrake_marl.episode.play import played
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.learners.branches import Act, Moment, moving, play_on
from ethbrake_marl.extensions.learners.networks import Averaged, Memory, drawn, perceptron, silent
from ethbrake_marl.extensions.learners.recipes import ExpertsPlan, VineRecipe
from ethbrake_marl.extensions.learners.vine import Actor, VineModel
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec

NO_DIFFERENCE = 1e-2  # returns that differ by less count as equal
ROUNDING = 1e-6  # of sums of shares, in updates

# templates: one command, then another one for a short while, then full braking
ATTENTION_S = 3.0  # the second command begins at most this time after the first decision
LONGEST_WHILE_S = 0.8  # and lasts at most this long
FULL_BRAKE_SHARE = 0.8  # probability that the first command is full braking
LIKELY_ACTIONS, THEIR_SHARES = np.array([-1.0, 1.0, 0.0]), np.array([0.35, 0.5, 0.6])  # cumulative; else uniform


class NoBetterTemplate(EthBrakeError, ValueError):
    """No template (random braking profile) has a higher return than the earlier experts: there is nothing to learn."""


class Stage(NamedTuple):
    expert: int | None  # number of the expert that is trained; None: the gating network
    first: int  # number of its first update, from 0
    end: int  # number of the first update after it


def stages_of(plan: ExpertsPlan, updates: int) -> tuple[Stage, ...]:
    """Return the stages of a training with this number of updates. A stage with a small share may have no update."""
    shares, others = plan.shares, plan.networks - 1
    parts: list[tuple[int | None, float]] = [(0, shares.pretraining_first)]
    parts += [(k + 1, shares.pretraining_others / others) for k in range(others)]
    stages, done, first = [], 0.0, 0
    for expert, share in [*parts, (None, shares.gating)]:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        stages.append(Stage(expert, first, end))
        first = end
    return tuple(stages)


class Mixture(nn.Module):
    def __init__(self, inputs: int, recipe: VineRecipe) -> None:
        super().__init__()
        plan, rate = recipe.experts, recipe.learning_rate.at(1.0)
        assert plan is not None
        self.actors: Any = nn.ModuleList([Actor(inputs, recipe) for _ in range(plan.networks)])
        average = silent(perceptron(inputs, plan.networks, plan.gating, recipe.network.activation))  # the first acts
        self.gate = Averaged(average, copy.deepcopy(average), rate)
        self.memory = Memory(plan.gating_memory, seen=torch.zeros(inputs), more=torch.zeros(plan.networks))

    def means(self, observations: Float32s) -> Float32s:
        """Return the actors' unclipped outputs, [rows], each of the actor chosen for the observation [rows, F]."""
        chosen, means = self.gate.best(observations), np.empty(len(observations), np.float32)
        for number, actor in enumerate(self.actors):
            rows = np.flatnonzero(chosen == number)
            means[rows] = actor.means(observations[rows])
        return means

    def act(self, observations: Float32s) -> Float32s:
        return np.clip(self.means(observations), -1.0, 1.0)

    def tensors(self, network: NetworkSpec) -> dict[str, Float32s]:
        tensors = self.gate.tensors("gate")
        for name, actor in zip(network.actors, self.actors, strict=True):
            tensors |= actor.tensors(name)
        return tensors


class Explored(NamedTuple):
    """The first n worlds of the training, and the best results of earlier experts in them."""

    start: State  # at the first decision
    gained: Floats  # [n] highest return
    harm: Floats  # [n] least harm, m2/s2


class Shown(NamedTuple):
    """Decisions of templates (random braking profiles) that a new expert imitates."""

    seen: Float32s  # [m, F] observations
    action: Float32s  # [m]


class MixtureModel(VineModel):
    policy: Mixture  # type: ignore[assignment]

    def new_policy(self) -> nn.Module:
        assert self.recipe.experts is not None
        self.plan = self.recipe.experts
        self.stage: Stage | None = None
        self.own: State | None = None  # worlds of the stage's expert, at the first decision
        self.number = 0  # of this update
        return Mixture(len(self.features), self.recipe)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        actors = [f"policy.actors.{k}.optimizer" for k in range(self.plan.networks)]
        return ["policy", *actors, "policy.gate.optimizer"], []

    def collect(self, callback: BaseCallback) -> tuple[Float32s, State]:
        """Return visited decisions: in all worlds or, for a second or later expert, of episodes in its own worlds."""
        each = self.n_envs * self.recipe.n_steps
        self.number, updates = self.num_timesteps // each, -(-self._total_timesteps // each)
        stage = next(one for one in stages_of(self.plan, updates) if one.first <= self.number < one.end)
        if stage != self.stage:
            self.enter(stage)
        if self.own is None:
            return self.visit(callback, self.policy.act if stage.expert is None else self.policy.actors[0].act)
        self.num_timesteps += each
        seen, states = [], []

        def decide(now: Moment) -> Floats:
            seen.append(now.seen[:, 0])
            states.append(now.state)
            return now.ask(self.policy.actors[stage.expert].act)

        play_on(self.game, self.own.take(torch.randint(self.own.n, (self.n_envs,)).numpy()), decide, 1.0)
        return np.concatenate(seen), State.join(states)

    def improve(self, seen: Float32s, states: State) -> None:
        stage, policy = self.stage, self.policy
        assert stage is not None
        self._update_current_progress_remaining(self.number - stage.first, stage.end - stage.first)
        if stage.expert is None:
            self.train_gate(*self.compare(seen, states))
        else:
            expert = policy.actors[stage.expert]
            self.train_actor(expert, self.try_out(seen, states, expert))

    def enter(self, stage: Stage) -> None:
        """Prepare a stage that begins, or is resumed.

        A second or later expert first imitates templates; then the worlds of its training are selected. This depends
        only on the earlier experts, so a resumed training repeats it exactly. Raises ``NoBetterTemplate`` if there is
        nothing to imitate, or no world to select.
        """
        self.stage, self.own = stage, None
        if not stage.expert:
            return
        explored = self.explore([actor.act for actor in self.policy.actors[: stage.expert]])
        shown = self.show(explored, *self.best_templates(explored))
        pupil = copy.deepcopy(self.policy.actors[0])
        self.imitate(pupil, shown, self.recipe.seed + stage.expert)
        self.own = self.worlds_of(pupil.act, explored)
        if len(shown.action) == 0 or self.own.n == 0:
            raise NoBetterTemplate(
                f"experts: expert {stage.expert + 1} has nothing to learn: in none of {self.plan.worlds:,} worlds"
                f" does one of {self.plan.templates} random braking profiles (templates) improve the return of the"
                f" earlier experts by more than {self.plan.gain:g}; set fewer networks, or remove the key experts"
            )
        if self.number == stage.first:
            self.policy.actors[stage.expert].load_state_dict(pupil.state_dict())

    def explore(self, acts: list[Act]) -> Explored:
        worlds = self.rows.scenario.sample(self.plan.worlds, self.recipe.seed, channel="training")
        start = self.game.reset(worlds)
        gained, harm = np.full(start.n, -np.inf), np.full(start.n, np.inf)
        for act in acts:
            its_gain, its_harm = self.drive_from(start, act, self.recipe.reward.harm_count)
            gained, harm = np.maximum(gained, its_gain), np.minimum(harm, its_harm)
        return Explored(start, gained, harm)

    def drive_from(self, state: State, act: Act, count: str) -> tuple[Floats, Floats]:
        gained, last = play_on(self.game, state, lambda now: now.ask(act), self.recipe.gamma)
        return gained[:, 0], self.harm(last, count)[:, 0]

    def best_templates(self, explored: Explored) -> tuple[Ints, Floats]:
        """Draw random templates in each world; return the worlds [m] in which one does less harm than all experts.

        Also return the best template's actions there, [m, T]. A template is a random braking profile. No search
        improves it: a random one with little harm tolerates small errors of its actions, so a policy can imitate it.
        """
        count, start = self.recipe.reward.harm_count, explored.start
        generator = np.random.default_rng(self.recipe.seed)
        attention, longest = (max(round(s / self.game.rules.time_step_s), 1) for s in (ATTENTION_S, LONGEST_WHILE_S))
        best, least = np.full((start.n, attention + longest), -1.0), explored.harm.copy()
        for _ in range(self.plan.templates):
            plans = random_templates(generator, start.n, attention, longest)
            last, _ = played(self.game, start, plans[:, :, np.newaxis], count)
            harm = self.harm(last, count)[:, 0]
            better = harm < least
            best[better], least[better] = plans[better], harm[better]
        rows = np.flatnonzero(least < explored.harm)
        return rows, best[rows]

    def show(self, explored: Explored, rows: Ints, actions: Floats) -> Shown:
        """Simulate templates ``actions`` [m, T] in the worlds ``rows``; return the decisions of the good ones."""
        seen, wanted, whose = [np.zeros((0, len(self.features)), np.float32)], [np.zeros(0)], [np.zeros(0, np.int64)]

        def decide(now: Moment) -> Floats:
            seen.append(now.seen[:, 0])
            whose.append(now.rows)
            wanted.append(actions[now.rows, min(now.number, actions.shape[1] - 1)])
            return wanted[-1][:, np.newaxis]

        gained, _ = play_on(self.game, explored.start.take(rows), decide, self.recipe.gamma)
        shown = (gained[:, 0] > explored.gained[rows] + self.plan.gain)[np.concatenate(whose)]
        return Shown(np.concatenate(seen)[shown], np.concatenate(wanted).astype(np.float32)[shown])

    def imitate(self, pupil: Actor, shown: Shown, seed: int) -> None:
        pupil.new_optimizer(self.lr_schedule(1.0))
        seen, wanted = torch.from_numpy(shown.seen), torch.from_numpy(shown.action)
        generator = torch.Generator().manual_seed(seed)
        for _ in range(self.plan.imitation_epochs):
            for batch in torch.split(torch.randperm(len(wanted), generator=generator), self.recipe.batch_size):
                means, target = pupil.learning(seen[batch])[:, 0], wanted[batch]
                reached = (target.abs() >= 1.0) & (means * target >= 1.0)  # an output beyond a bound is clipped to it
                pupil.descend(mse_loss(means, torch.where(reached, means.detach(), target)), self.recipe.averaging)
        pupil.follow(0.0)

    def worlds_of(self, act: Act, explored: Explored) -> State:
        """Return the worlds in which a new expert is trained further; ``act`` is its policy after imitation.

        These are worlds in which it is better than the best earlier expert, or not much worse. Left out are worlds in
        which both are equal, or in which the earlier expert does no harm.
        """
        gained, _ = self.drive_from(explored.start, act, self.recipe.reward.harm_count)
        more = gained - explored.gained
        own = (more > -self.plan.margin) & (np.abs(more) > NO_DIFFERENCE) & (explored.harm > 0.0)
        return explored.start.take(np.flatnonzero(own))

    def compare(self, seen: Float32s, states: State) -> tuple[Float32s, Floats]:
        """Let each of K experts drive on from some visited decisions at which they differ.

        Returns the observations, [B, F], and the experts' costs, [B, K]: minus the return, plus ``tie_break`` times the
        harm by the count that the reward does not use.
        """
        policy, plan = self.policy, self.plan
        actions = np.stack([actor.act(seen) for actor in policy.actors])
        differ = np.flatnonzero((np.ptp(actions, axis=0) > 1e-2) & moving(states))
        rows = drawn(differ, plan.gating_states)
        start, other = states.take(rows), other_count(self.recipe.reward.harm_count)
        costs = np.empty((len(rows), plan.networks))
        for k, actor in enumerate(policy.actors):
            gained, harm = self.drive_from(start, actor.act, other)
            costs[:, k] = plan.tie_break * harm - gained
        return seen[rows], costs

    def train_gate(self, seen: Float32s, costs: Floats) -> None:
        """Train the gating network to choose the cheapest expert. A wrong choice is weighted by its extra cost."""
        gate, memory, plan = self.policy.gate, self.policy.memory, self.plan
        self._update_learning_rate(gate.optimizer)
        more = (costs - costs.min(axis=1, keepdims=True)).astype(np.float32)
        rows = np.flatnonzero(more.max(axis=1) > 1e-9)
        memory.store(seen=seen[rows], more=more[rows])
        if len(rows):
            regret = np.take_along_axis(more[rows], gate.best(seen[rows])[:, np.newaxis], axis=1)
            self.logger.record("gating/regret", float(regret.mean()))
        losses = []
        for _ in range(plan.gating_steps if len(memory) else 0):
            some = torch.randint(len(memory), (self.recipe.batch_size,))
            costlier = memory.get_buffer("more")[some]
            scores = gate.learning(memory.get_buffer("seen")[some])
            best = scores.gather(1, costlier.argmin(dim=1, keepdim=True))
            loss = (costlier * softplus(scores - best)).sum(dim=1).mean()
            losses.append(gate.descend(loss, self.recipe.averaging).item())
        if losses:
            self.logger.record("gating/loss", float(np.mean(losses)))


def random_templates(generator: np.random.Generator, n: int, attention: int, longest: int) -> Floats:
    """Return the actions of n random templates, [n, attention + longest]. They end with full braking."""
    first, length = generator.integers(0, attention, n), generator.integers(1, longest + 1, n)
    between, before = random_actions(generator, n), random_actions(generator, n)
    before[generator.random(n) < FULL_BRAKE_SHARE] = -1.0
    steps, begin, end = np.arange(attention + longest), first[:, np.newaxis], (first + length)[:, np.newaxis]
    return np.where(steps < begin, before[:, np.newaxis], np.where(steps < end, between[:, np.newaxis], -1.0))


def random_actions(generator: np.random.Generator, n: int) -> Floats:
    """Return n random actions; full braking, full driving and coasting are likely."""
    kind = np.searchsorted(THEIR_SHARES, generator.random(n), side="right")
    uniform = generator.uniform(-1.0, 1.0, n)
    return np.where(kind < len(LIKELY_ACTIONS), np.append(LIKELY_ACTIONS, 0.0)[kind], uniform)
