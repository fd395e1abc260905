"""Actors that learn from targets: their networks, optimiser, running average, and the limits on a step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Space, flatdim
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor, nn
from torch.optim import Optimizer

from ethbrake_marl.engine.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.learners.recipes import CounterfactualRecipe
from ethbrake_marl.extensions.learners.scout import Scout
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Bools, Floats
from ethbrake_marl.policies.manifest import Float32s
from ethbrake_marl.policies.network import Policy
from ethbrake_marl.training.networks import ACTIVATIONS
from ethbrake_marl.training.run_folder import Training


def widened(policy: Policy, training: Training) -> dict[str, NDArray[np.float32]]:
    """The actor's tensors of ``policy`` for what the training observes; features that are new to it count for nothing.

    Raises ``InvalidInput`` where the training does not observe all that the policy does, or has another network.
    """
    recipe, wanted = training.recipe, training.recipe.network_spec(training.observation.size)
    found = policy.manifest.network
    if found.networks > 1:
        raise InvalidInput(f"recipe {recipe.name!r}: start: has {found.networks} networks; give a policy of one")
    for name in ("policy_hidden", "activation", "output"):
        if getattr(found, name) != getattr(wanted, name):
            raise InvalidInput(
                f"recipe {recipe.name!r}: network: {name} is {getattr(wanted, name)}, but {getattr(found, name)} in the"
                " policy to start from; they must be the same"
            )
    return padded(policy, training, "start")


def padded(policy: Policy, training: Training, key: str) -> dict[str, NDArray[np.float32]]:
    """All tensors of ``policy`` but a critic's, for what the training observes; features new to it count for nothing.

    Raises ``InvalidInput``, naming the recipe's ``key``, where the training does not observe all that the policy does.
    """
    names = [feature.name for feature in training.observation.features]
    known = policy.manifest.observation.features
    missing = [name for name in known if name not in names]
    if missing:
        raise InvalidInput(
            f"recipe {training.recipe.name!r}: observation: lacks {', '.join(missing[:5])}, which the policy of {key}"
            " observes; list what it observes, and more"
        )
    found = {name: tensor.copy() for name, tensor in policy.tensors.items() if not name.startswith("value.")}
    for name in [name for name in found if name.endswith(".0.weight")]:
        first = np.zeros((len(found[name]), len(names)), np.float32)
        first[:, [names.index(feature) for feature in known]] = found[name]
        found[name] = first
    return found


class Adam(torch.optim.Adam):
    """torch's, to the bit, without what imports torch's compiler (1 to 3 CPU-s), which has nothing to do here."""


def adam(rate: float, *networks: nn.Module | None) -> Adam:
    """An optimiser of all weights of these networks."""
    return Adam([weight for each in networks if each is not None for weight in each.parameters()], lr=rate, eps=1e-5)


def descend(optimizer: Optimizer, *losses: Tensor) -> None:
    """One step down the sum of these losses."""
    optimizer.zero_grad()
    for loss in losses:
        loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@torch.no_grad()
def follow(average: Iterable[Tensor], learning: nn.Module, keep: float) -> None:
    """Move an average of weights towards the weights that learn, keeping this share of what it was."""
    for mean, learns in zip(average, learning.parameters(), strict=True):
        mean.lerp_(learns, 1.0 - keep)


class Deterministic(BasePolicy):
    """A policy whose actions are its ``means``, cut at -1 and 1."""

    def means(self, observation: Float32s) -> Float32s:
        """What the weights that learn say to observations [rows, F], [rows]; beyond -1 and 1 it means -1 and 1."""
        raise NotImplementedError

    def expect(self, observation: Float32s) -> Floats:
        """The size of the gradient that is to be expected, [rows]."""
        raise NotImplementedError

    def act(self, observation: Float32s) -> Float32s:
        """Its actions [rows] in [-1, 1]."""
        return np.clip(self.means(observation), -1.0, 1.0)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        found: Tensor = self.forward(observation)
        return found


class AveragedActor(Deterministic):
    """An actor that learns (``learning``), and the running average of its weights, which drives.

    The average stands under the names of Stable-Baselines3's PPO, as a bundle wants it.
    """

    def __init__(
        self, observation_space: Space[Any], action_space: Any, rate: Schedule, recipe: CounterfactualRecipe
    ) -> None:
        super().__init__(observation_space, action_space)
        inputs, shape = flatdim(observation_space), recipe.network
        hidden, activation = list(shape.policy), ACTIVATIONS[shape.activation]
        self.mlp_extractor = nn.ModuleDict({"policy_net": nn.Sequential(*create_mlp(inputs, -1, hidden, activation))})
        self.action_net = nn.Linear(hidden[-1], 1)
        for layer in self.mlp_extractor.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
                nn.init.zeros_(layer.bias)
        nn.init.orthogonal_(self.action_net.weight, 0.01)
        nn.init.constant_(self.action_net.bias, shape.initial_action or 0.0)
        # of the bundle: the actor itself never explores
        self.log_std = nn.Parameter(torch.full((1,), -3.0), requires_grad=False)
        last = nn.Linear(hidden[-1], 1)
        self.learning = nn.Sequential(*create_mlp(inputs, -1, hidden, activation), last)
        self.average = [*self.mlp_extractor.parameters(), *self.action_net.parameters()]
        self._spec = shape.spec(inputs)
        self._learn_from_average()
        self.scout = Scout(inputs) if recipe.focus > 0.0 else None
        self.optimizer = adam(rate(1.0), self.learning, self.scout)

    @torch.no_grad()
    def _learn_from_average(self) -> None:
        for mean, learns in zip(self.average, self.learning.parameters(), strict=True):
            learns.copy_(mean)

    def take_over(self, tensors: Mapping[str, Float32s]) -> None:
        """Begin with these tensors of a bundle."""
        state = self.state_dict()
        for row in self._spec.tensors:
            state[row.sb3_name].copy_(torch.from_numpy(tensors[row.name]))
        self._learn_from_average()

    @torch.no_grad()
    def means(self, observation: Float32s) -> Float32s:
        found: Float32s = self.learning(torch.from_numpy(observation))[:, 0].numpy()
        return found

    def expect(self, observation: Float32s) -> Floats:
        assert self.scout is not None
        return self.scout.expect(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [rows, 1] of the average."""
        means: Tensor = self.action_net(self.mlp_extractor["policy_net"](observation))
        return means.clamp(-1.0, 1.0)


class Tried(NamedTuple):
    """Decisions that were tried in two ways, and what that brought."""

    seen: Float32s  # [B, F]
    mean: Float32s  # [B] what the actor said; beyond -1 and 1 it means -1 and 1
    gradient: Float32s  # [B] of the return by the action
    importance: Float32s  # [B] what each counts


# ``gradient_limit: auto``: limit and smallest offset follow the gradients that were measured last.

REMEMBERED = 65_536  # measured gradients

CUT = 0.1  # share of the sum of their sizes that the limit cuts

SPREAD = 2.0  # at the smallest offset the spread of gradients is at most so many times that at the largest

NARROWEST = 4.0  # but offsets are drawn from a range at least so wide


def limit_that_cuts(sizes: Floats, share: float) -> float:
    """The limit at which cutting takes this share of the sum of these sizes [n]."""
    rising = np.sort(sizes)
    kept = np.cumsum(rising) + np.arange(len(rising) - 1, -1, -1) * rising  # of the sum, by each of them as the limit
    return float(np.interp((1.0 - share) * kept[-1], kept, rising))


def smallest_offset(measured: Floats, least: float, most: float) -> float:
    """The smallest offset to draw: ``least``, or more where the spread of gradients falls steeply with the offset.

    A jump of the harm makes the spread fall as the root of the offset, a smooth harm leaves it as it is. The slope is
    that between the smaller and the larger half of the offsets of ``measured`` [n, 2], sizes and offsets (0: none yet).
    """
    known = measured[measured[:, 1] > 0.0]
    halves = np.array_split(known[np.argsort(known[:, 1], kind="stable")], 2)
    if not all(half[:, 0].any() for half in halves):
        return least
    near, far = (log(float(np.mean(half[:, 0] * half[:, 0]))) / 2.0 for half in halves)
    apart = log(float(np.median(halves[1][:, 1]) / np.median(halves[0][:, 1])))
    lower = exp(-log(SPREAD) * apart / (near - far)) if near > far else 0.0
    return max(least, most * min(lower, 1.0 / NARROWEST))


def other_count(count: HarmCount) -> HarmCount:
    """Of both, the one that it is not."""
    return "total" if count == "first" else "first"


def moving_rows(moments: State) -> Bools:
    """In which rows some vehicle moves; where everything stands there is nothing to learn."""
    column = moments.packed.column
    moving: Bools = (moments.motion[:, column.speed : column.command] != 0.0).any(axis=1)
    return moving


def trusted_targets(tried: Tried, radius: float, anchor: float) -> tuple[Float32s, Float32s]:
    """Where the means [B] should go, and how much that weighs [B]: ``m + g / w`` with ``w = |g| / radius + anchor``.

    Half the weighted squared distance from there is, up to a constant, ``-g (mu - m) + w (mu - m)^2 / 2``: the exact
    slope, and a curvature with which nothing moves farther than the radius, however large its gradient. A mean at or
    beyond a bound is not asked to go farther out, where its action would not change.
    """
    outward = ((tried.mean >= 1.0) & (tried.gradient > 0.0)) | ((tried.mean <= -1.0) & (tried.gradient < 0.0))
    gradient = tried.gradient.copy()
    gradient[outward] = 0.0
    weight = (np.abs(gradient) / radius + anchor).astype(np.float32)
    target: Float32s = tried.mean + gradient / weight
    return target, weight
