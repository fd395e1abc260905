"""Options: several actions are tried at a decision, and the actor learns to choose the one that costs least."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space, flatdim
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.nn.functional import softplus

from ethbrake_marl.engine.state import State
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.extensions.learners.actors import (
    Deterministic,
    adam,
    descend,
    follow,
    moving_rows,
    other_count,
    padded,
)
from ethbrake_marl.extensions.learners.branches import play_on
from ethbrake_marl.extensions.learners.recipes import OptionsRecipe
from ethbrake_marl.extensions.learners.scout import draw_rows
from ethbrake_marl.extensions.learners.vine_model import CounterfactualModel
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.state import Floats, Ints
from ethbrake_marl.policies.manifest import Float32s
from ethbrake_marl.policies.network import Actor, Layers
from ethbrake_marl.scenario.sampling import members_of
from ethbrake_marl.training.networks import ACTIVATIONS
from ethbrake_marl.training.run_folder import Algorithm, Training

FOR_GOOD = 2**31  # steps: more than any episode has

USUAL_KEPT = 0.98  # share of itself that the running mean of costs keeps in each update

LEAST_USUAL = 0.1  # m2/s2: a scenario with next to no harm counts no more than one with so much


class Options(Algorithm):
    """Policy iteration by what actions cost in closed loop; one actor for all learners."""

    def build(self, training: Training, environment: EthBrakeVecEnv) -> OptionsModel:
        """The model, from random weights and full braking."""
        recipe = training.recipe
        assert isinstance(recipe, OptionsRecipe)
        environment.engine.branch(environment.engine.moment())  # refuses what cannot be branched before it begins
        among = [padded(policy, training, "among") for policy in recipe.policies]
        return OptionsModel(environment, recipe, among)


class _TorchActor(Actor):
    """The actor of a bundle, three times as fast, to other last bits."""

    @torch.no_grad()
    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        activation = torch.relu if self.spec.activation == "relu" else torch.tanh
        y: Tensor = torch.from_numpy(x)
        for number, (weight, bias) in enumerate(layers, start=1):
            y = torch.addmm(torch.from_numpy(bias)[:, None], torch.from_numpy(weight), y)
            y = y if number == len(layers) else activation(y)
        found: Float32s = y.numpy()
        return found


class ChoosingActor(Deterministic):
    """An actor that scores actions (``learning``), the average of its weights (``average``), which drives, and what it
    remembers: the last decisions at which actions were tried, and how much more than the best one each of them costs.
    """

    seen: Tensor  # [M, F]
    tried: Tensor  # [M, C] numbers of actions, the one that was taken first
    more: Tensor  # [M, C]
    known: Tensor  # [1] decisions so far; the newest take the places of the oldest
    usual: Tensor  # [members] what the best action tried costs on average in each scenario of a mixture; 0: not known

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        rate: Schedule,
        recipe: OptionsRecipe,
        among: Sequence[Mapping[str, Float32s]],
        members: int,
    ) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape, room = flatdim(observation_space), recipe.network, (recipe.memory, 1 + recipe.others)
        self.first, scores = len(among), len(among) + shape.choices  # the number of the first action behind policies
        layers = create_mlp(inputs, scores, list(shape.policy), ACTIVATIONS[shape.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # until it learns, it takes the first: a policy's
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]  # action, or full braking
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.optimizer = adam(rate(1.0), self.learning)
        spec = recipe.network_spec(inputs)
        tensors = {f"among_{m}.{name}": each[name] for m, each in enumerate(among, 1) for name in each}
        for name, tensor in tensors.items():
            self.register_buffer(name.replace(".", "_"), torch.from_numpy(tensor))
        chooser = {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors if row.name not in tensors}
        self.take = _TorchActor(spec, {**chooser, **tensors}).take
        self.register_buffer("usual", torch.zeros(members, dtype=torch.float64))
        self.register_buffer("seen", torch.zeros(recipe.memory, inputs))
        self.register_buffer("tried", torch.zeros(room, dtype=torch.int64))
        self.register_buffer("more", torch.zeros(room))
        self.register_buffer("known", torch.zeros(1, dtype=torch.int64))

    @torch.no_grad()
    def choose(self, observation: Float32s) -> Ints:
        """Numbers of its actions [rows] for observations [rows, F]."""
        chosen: Ints = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen

    def act(self, observation: Float32s) -> Float32s:
        found: Float32s = self.take(self.choose(observation), observation.T)[0]
        return found

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        return torch.from_numpy(self.act(observation.numpy()))[:, None]

    def remember(self, seen: Float32s, tried: Ints, more: Floats) -> None:
        """Keep decisions."""
        places = torch.arange(int(self.known), int(self.known) + len(seen)) % len(self.seen)
        self.seen[places], self.tried[places] = torch.from_numpy(seen), torch.from_numpy(tried)
        self.more[places] = torch.from_numpy(more.astype(np.float32))
        self.known += len(seen)

    def draw(self, batches: int, count: int, focus: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Some of the kept decisions for each step, and what each of them counts; ``focus`` as for ``draw_rows``."""
        known = min(int(self.known), len(self.seen))
        if focus == 0.0 or batches == 0:
            for _ in range(batches):
                yield torch.randint(known, (count,)), torch.ones(count)
            return
        rows, importance = draw_rows(self.more[:known].max(dim=1).values.numpy(), batches * count, focus)
        for start in range(0, len(rows), count):
            part = slice(start, start + count)
            yield torch.from_numpy(rows[part]), torch.from_numpy(importance[part])

    def loss(self, some: Tensor, importance: Tensor, guide: float) -> Tensor:
        """Of some of the kept decisions: the expected cost of choosing with the chances of a softmax of the scores.

        Where the chances are nearly 0 or 1 this has no slope. So ``guide`` times a convex loss is added: each action
        that is not the best should have a lower score, the more so the more it costs.
        """
        more = self.more[some]
        scores = self.learning(self.seen[some]).gather(1, self.tried[some])
        best = scores.gather(1, more.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * more).sum(dim=1)
        found: Tensor = (importance * (expected + guide * (more * softplus(scores - best)).sum(dim=1))).mean()
        return found


class OptionsModel(CounterfactualModel):
    """Visits decisions by its actor, tries several actions at some of them, and learns what each costs."""

    policy: ChoosingActor  # type: ignore[assignment]
    recipe: OptionsRecipe  # type: ignore[assignment]

    def __init__(
        self, environment: EthBrakeVecEnv, recipe: OptionsRecipe, among: Sequence[Mapping[str, Float32s]]
    ) -> None:
        self._among = among
        super().__init__(environment, recipe)  # type: ignore[arg-type]  # it has what all models ask for

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        members = len(self.engine.scenario.members) or 1
        self.policy = ChoosingActor(
            self.observation_space, self.action_space, self.lr_schedule, self.recipe, self._among, members
        )

    def _update(self, told: BaseCallback, total: int) -> None:
        recipe, actor = self.recipe, self.policy
        seen, moments = self._visit(told, actor.act)
        told.on_rollout_end()
        self._update_current_progress_remaining(self.num_timesteps, total)
        self._update_learning_rate(actor.optimizer)
        observed, tried, costs = self._try_actions(seen, moments)
        more = costs - costs.min(axis=1, keepdims=True)
        telling = np.flatnonzero(more.max(axis=1) > 1e-9)
        more = np.minimum(more, recipe.largest_cost)
        actor.remember(observed[telling], tried[telling], more[telling])
        self.logger.record("train/regret", float(more[:, 0].mean()) if len(more) else 0.0)
        self.logger.record("train/telling", len(telling))
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
        """At some decisions: what is seen [B, F], numbers of the actions tried [B, C], and what each costs [B, C].

        The first one is the one that the actor takes. ``caution`` is part of the costs.
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
        if recipe.caution:  # one more branch of each decision brakes fully from there to the end
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
        before = engine.ledger.world_harm(other)
        gained = play_on(engine, decide, recipe.gamma, at_least=max(recipe.holds))
        found = -gained[np.arange(len(row)), learner]
        if recipe.tie_break:
            found += recipe.tie_break * (engine.ledger.world_harm(other) - before)
        costs = found[back].reshape(tried.shape)
        if recipe.caution:
            done = 1.0 - self._current_progress_remaining
            costs += recipe.caution * done * np.maximum(costs - found[len(each) :, np.newaxis], 0.0)
        good = np.isfinite(costs).all(axis=1)
        rows, tried, costs = rows[good], tried[good], costs[good]
        if recipe.relative and len(rows):
            costs /= self._usual(rows // learners, costs.min(axis=1))[:, np.newaxis]
        return observed[rows], tried, costs

    def _usual(self, rows: Ints, least: Floats) -> Floats:
        """What decisions [B] of these rows usually cost in their scenarios [B], to which these costs are added."""
        numbers = self._numbers[rows]
        first = int(numbers.min())
        drawn = members_of(
            self.engine.scenario, int(numbers.max()) - first + 1, self.engine.seed, first=first, channel="training"
        )
        member, usual = drawn[numbers - first], self.policy.usual.numpy()
        for m in np.unique(member):
            mean = float(least[member == m].mean())
            usual[m] = USUAL_KEPT * usual[m] + (1.0 - USUAL_KEPT) * mean if usual[m] else mean
        found: Floats = np.maximum(usual[member], LEAST_USUAL)
        return found
