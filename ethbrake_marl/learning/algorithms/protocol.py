"""The protocol of a learning algorithm: what training, saving, resuming and making a policy need of it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ethbrake_marl.learning.recipe import Fraction, Layers, NonNegative, Positive, Rate
from ethbrake_marl.learning.training import Training

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv


class Algorithm(ABC):
    """A learning algorithm on a model of Stable-Baselines3, or on one of your own made from its ``BaseAlgorithm``.

    ``build`` is needed. The other methods say what a checkpoint holds and what is checked; as they stand here they fit
    a model whose ``policy`` has one ``optimizer``, as in PPO and A2C.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """A fresh model on the CPU, seeded by the recipe; a function of its two arguments and of nothing else."""

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """What drives: one for all learners, or under ``independent`` one for each, front to rear.

        Its state holds the tensors of ``policies.manifest.tensor_table`` for the recipe's ``network_spec``.
        """
        return (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Every optimiser by a name of its own, always in this order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Learned numbers that stand outside the model's policy, by name; a checkpoint keeps them."""
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of how much it explores, which must stay a usable number; None: nothing to check."""
        found: Tensor | None = getattr(model.policy, "log_std", None)
        return None if found is None else found.detach()


# Modes: what a recipe says of learning several networks and a gate, and which updates of a training do what.

ROUNDING = 1e-6  # of sums of shares, in updates


class Shares(BaseModel):
    """Of all updates, the share of each stage; together they are 1."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    alone: Fraction  # the first network, in all worlds
    further: Fraction  # each of the others in the worlds of its own mode, one after the other
    gate: Fraction  # the gate between them
    together: Fraction  # all networks and the gate, each network where the gate chooses it

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.alone + self.further + self.gate + self.together
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(f"alone, further, gate and together are {total:g} in all; must be 1")
        return self


class ModesPlan(BaseModel):
    """How many networks, how the worlds of each further one are found, and how the gate between them learns."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    networks: Annotated[int, Field(ge=2, le=16)]
    gate: Layers  # hidden layers
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # in which a mode is looked for
    templates: Annotated[int, Field(ge=1, le=100_000)]  # drawn in each of them
    gain: NonNegative  # return by which a template must be better than all networks before to be imitated
    margin: Positive  # return by which a network may be worse than those before in a world of its own
    imitation_epochs: Annotated[int, Field(ge=1, le=1000)]
    gate_states: Annotated[int, Field(ge=1, le=1_000_000)]  # in each update, at which networks are compared
    gate_memory: Annotated[int, Field(ge=1, le=1_000_000)]  # of them that are remembered
    gate_steps: Annotated[int, Field(ge=1, le=100_000)]  # of its optimiser in each update
    tie_break: NonNegative  # of the harm by the other count, added to minus the return when networks are compared
    together_rate: Rate  # share of the learning rate in the last stage
    shares: Shares


class Stage(NamedTuple):
    """What a stretch of updates is for."""

    does: Literal["alone", "further", "gate", "together"]
    network: int  # that of ``further``
    first: int  # update, from 0
    end: int  # the first update after it


def stages_of(plan: ModesPlan, updates: int) -> tuple[Stage, ...]:
    """The stages of a training with so many updates, in order; some may be empty."""
    shares, more = plan.shares, plan.networks - 1
    parts: list[tuple[Literal["alone", "further", "gate", "together"], int, float]] = [("alone", 0, shares.alone)]
    parts += [("further", k + 1, shares.further / more) for k in range(more)]
    parts += [("gate", 0, shares.gate), ("together", 0, shares.together)]
    found, done, first = [], 0.0, 0
    for does, network, share in parts:
        done += share
        end = min(math.ceil(done * updates - ROUNDING), updates)
        found.append(Stage(does, network, first, end))
        first = end
    return tuple(found)
