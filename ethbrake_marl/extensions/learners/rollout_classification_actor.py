"""Actor that gives each of several actions a score, and takes the action with the highest score.

The actor also has a memory of tried actions and their costs, from which it learns.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space, flatdim
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.nn.functional import softplus

from ethbrake_marl.extensions.learners.averaged_actor import Deterministic
from ethbrake_marl.extensions.learners.optimizer import adam
from ethbrake_marl.extensions.learners.rollout_classification_recipe import RolloutClassificationRecipe
from ethbrake_marl.extensions.learners.scout import draw_rows
from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.policies.actor import Actor
from ethbrake_marl.first_edition.policies.layers import Layers
from ethbrake_marl.first_edition.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.first_edition.training.networks import ACTIVATIONS, copy_of, tensors_of_layers


class _TorchActor(Actor):
    """Copy of the class ``Actor`` that multiplies matrices with torch: three times as fast, equal but for rounding."""

    @torch.no_grad()
    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        activation = torch.relu if self.spec.activation == "relu" else torch.tanh
        y: Tensor = torch.from_numpy(x)
        for number, (weight, bias) in enumerate(layers, start=1):
            y = torch.addmm(torch.from_numpy(bias)[:, None], torch.from_numpy(weight), y)
            y = y if number == len(layers) else activation(y)
        outputs: Float32s = y.numpy()
        return outputs


class ChoosingActor(Deterministic):
    """Actor that takes the choice to which its network gives the highest score.

    Each choice has a number. A choice with a number below ``first`` is a trained policy, which then computes the
    action. The other choices are actions, evenly spaced from -1 to 1. The network ``learning`` is trained; ``average``
    has running averages of the weights of ``learning``, and chooses when the actor drives.

    A memory stores the last M decisions at which C choices were compared. The *extra cost* of a choice is its cost
    minus the cost of the cheapest choice at the same decision. F is the number of features of an observation.

    Args:
        observation_space: space of an observation.
        action_space: space of an action.
        rate: learning rate as a function of the share of the training run that remains (1 to 0).
        recipe: recipe of the training run.
        policies: for each trained policy that the actor can choose, a mapping from names to weights.
        members: number of scenarios in the mixture in which the actor is trained; 1 if the scenario is no mixture.

    """

    seen: Tensor  # [M, F] observations in memory
    tried: Tensor  # [M, C] numbers of the tried choices; the actor itself took the choice in column 0
    more: Tensor  # [M, C] extra cost of each tried choice
    known: Tensor  # [1] number of decisions added to the memory so far; a new decision replaces the oldest
    usual: Tensor  # [members] mean cost of the best tried choice in each scenario of a mixture; 0: not measured yet

    def __init__(
        self,
        observation_space: Space[Any],
        action_space: Any,
        rate: Schedule,
        recipe: RolloutClassificationRecipe,
        policies: Sequence[Mapping[str, Float32s]],
        members: int,
    ) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape, room = flatdim(observation_space), recipe.network, (recipe.memory, 1 + recipe.others)
        self.first, scores = len(policies), len(policies) + shape.choices  # numbers below ``first`` stand for policies
        layers = create_mlp(inputs, scores, list(shape.policy), ACTIVATIONS[shape.activation])
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]  # all scores of the untrained network are equal:
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]  # it takes choice 0, a policy or full braking
        self.average = nn.Sequential(*layers)
        self.learning = copy.deepcopy(self.average)
        self.optimizer = adam(rate(1.0), self.learning)
        spec = recipe.network_spec(inputs)
        tensors = {f"among_{m}.{name}": each[name] for m, each in enumerate(policies, 1) for name in each}
        self._names = tuple(tensors)  # names of the weights of the policies
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
        """Return the number, [rows], of the choice with the highest score for each of the observations [rows, F]."""
        chosen: Ints = self.average(torch.from_numpy(observation)).argmax(dim=1).numpy()
        return chosen

    def act(self, observation: Float32s) -> Float32s:
        actions: Float32s = self.take(self.choose(observation), observation.T)[0]
        return actions

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions [rows, 1] that the averaged network chooses for observations [rows, F]."""
        return torch.from_numpy(self.act(observation.numpy()))[:, None]

    def tensors(self, network: NetworkSpec) -> dict[str, Float32s]:
        of_policies = {name: copy_of(self.get_buffer(name.replace(".", "_"))) for name in self._names}
        return {**tensors_of_layers("policy", self.average), **of_policies}

    def remember(self, seen: Float32s, tried: Ints, more: Floats) -> None:
        """Store m decisions in the memory.

        ``seen`` [m, F] are the observations, ``tried`` [m, C] the numbers of the tried choices (column 0: the actor's
        own choice), and ``more`` [m, C] their extra costs.
        """
        places = torch.arange(int(self.known), int(self.known) + len(seen)) % len(self.seen)
        self.seen[places], self.tried[places] = torch.from_numpy(seen), torch.from_numpy(tried)
        self.more[places] = torch.from_numpy(more.astype(np.float32))
        self.known += len(seen)

    def draw(self, batches: int, count: int, focus: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Draw decisions from the memory for several gradient steps.

        Yields, for each of ``batches`` gradient steps, the indices of the drawn decisions in the memory, [count], and
        their weights in the loss (importance), [count]. In the share ``focus`` of the draws, the probability of a
        decision is proportional to its largest extra cost; the other draws are uniform.
        """
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
        """Return the loss at some decisions: (expected extra cost of a choice) + ``guide`` * (convex term).

        The probability of a choice is the softmax of the scores. If a probability is close to 0 or 1, the gradient of
        the expected extra cost nearly vanishes, but the gradient of the convex term does not. The convex term lowers
        the score of every tried choice except the cheapest one, in proportion to its extra cost. ``some`` are the
        indices of the decisions in the memory, and ``importance`` their weights in the loss.
        """
        more = self.more[some]
        scores = self.learning(self.seen[some]).gather(1, self.tried[some])
        best = scores.gather(1, more.argmin(dim=1, keepdim=True))
        expected = (scores.softmax(dim=1) * more).sum(dim=1)
        loss: Tensor = (importance * (expected + guide * (more * softplus(scores - best)).sum(dim=1))).mean()
        return loss
