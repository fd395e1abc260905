"""A training set-up as one YAML file: everything that shapes a policy, checked before anything starts."""

from __future__ import annotations

import math
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.learning.networks import Activation, NetworkSpec, Width
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario.yaml_loading import Document, read_yaml

ROLLOUT_LIMIT = 2**24  # decisions held in memory between two updates

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Layers = Annotated[tuple[Width, ...], Field(strict=False, min_length=1, max_length=8)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class LearningRate(_Part):
    """A learning rate that falls from ``start`` to ``end`` over the training."""

    start: Rate
    end: Rate
    schedule: Literal["cosine"] = "cosine"

    def at(self, remaining: float) -> float:
        """``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``, the share of steps done."""
        done = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * done))


class NetworkShape(_Part):
    """Hidden layers of actor and critic, and the exploration noise they start with."""

    policy: Layers
    value: Layers
    activation: Activation = "relu"
    initial_log_std: Annotated[float, Field(ge=-10.0, le=2.0)] = 0.0

    def spec(self, observation_size: int) -> NetworkSpec:
        """The whole network for one action in [-1, 1]."""
        return NetworkSpec(
            observation_size=observation_size,
            action_size=1,
            policy_hidden=self.policy,
            value_hidden=self.value,
            activation=self.activation,
            output="clip",
        )


class EvaluationPlan(_Part):
    """The fixed list on which the policy is measured while it learns."""

    every_updates: Annotated[int, Field(ge=1)]
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]
    seed: Annotated[int, Field(ge=0)]


class TrainingRecipe(_Part):
    """How to train: algorithm, its parameters, network, reward, seed, and what is saved and measured on the way."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")
    title: str = ""
    description: str = ""
    source: str = ""
    algorithm: Literal["ppo"]
    total_steps: Annotated[int, Field(ge=1)]
    n_envs: Annotated[int, Field(ge=1)]
    n_steps: Annotated[int, Field(ge=2)]
    batch_size: Annotated[int, Field(ge=2)]
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    learning_rate: LearningRate
    gamma: Fraction
    gae_lambda: Fraction
    clip_range: Rate
    ent_coef: NonNegative
    vf_coef: NonNegative
    max_grad_norm: Positive
    target_kl: Positive | None = None
    network: NetworkShape
    reward: RewardParams
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    evaluation: EvaluationPlan
    checkpoint_every_updates: Annotated[int, Field(ge=1)]

    @field_validator("reward")
    @classmethod
    def _some_reward(cls, value: RewardParams) -> RewardParams:
        if not any((value.harm, value.collision, value.risk, value.jerk, value.terminal)):
            raise ValueError("every weight is 0; nothing could be learned")
        return value

    @model_validator(mode="after")
    def _whole_batches(self) -> TrainingRecipe:
        rollout = self.n_envs * self.n_steps
        if not rollout <= ROLLOUT_LIMIT:
            raise ValueError(f"n_envs x n_steps = {rollout} decisions per update; at most {ROLLOUT_LIMIT}")
        if rollout % self.batch_size:
            raise ValueError(f"batch_size = {self.batch_size}: must divide n_envs x n_steps = {rollout}")
        return self

    def replace(self, **changes: Any) -> TrainingRecipe:
        """The same recipe with other values in some fields, checked again; raises ``InvalidInput``."""
        content = {**self.model_dump(mode="json"), **changes}
        return _checked(Document(f"recipe {self.name!r}", content, {}))


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read a shipped recipe by name (``ppo``) or a file by path (anything with a separator or ``.yaml``).

    Raises ``UnknownName`` with a suggestion, or ``InvalidInput`` with file, line, key, value and what would be right.
    """
    text = str(name_or_path)
    if Path(text).suffix in (".yaml", ".yml") or "/" in text or "\\" in text:
        return _checked(read_yaml(text))
    shipped = shipped_recipes()
    if text not in shipped:
        raise unknown_name("recipe", text, shipped)
    return _checked(read_yaml(shipped[text]))


def shipped_recipes() -> dict[str, Path]:
    """Name -> file of every recipe that comes with the package: the checkout's ``train/``, or the installed copy."""
    package = Path(__file__).resolve().parents[1]
    checkout, installed = package.parent / "train", package / "_data" / "train"
    folder = checkout if (package.parent / "pyproject.toml").is_file() and checkout.is_dir() else installed
    if not folder.is_dir():
        raise InvalidInput(f"the shipped recipes are missing: neither {checkout} nor {installed} exists; reinstall")
    return {file.stem: file for file in sorted(folder.glob("*.yaml"))}


def _checked(document: Document) -> TrainingRecipe:
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance algorithm: ppo")
    try:
        return TrainingRecipe.model_validate(document.content)
    except ValidationError as error:
        raise _explained(error, document) from None


def _explained(error: ValidationError, document: Document) -> InvalidInput:
    """The first defect, unknown keys before all others: file, line, path inside it, value, what would be right."""
    defects = sorted(error.errors(include_url=False), key=lambda defect: defect["type"] != "extra_forbidden")
    first, path = defects[0], defects[0]["loc"]
    line = document.line_of(path)
    place = f"{document.file}: " if line is None else f"{document.file}, line {line}: "
    name = ".".join(str(part) for part in path)
    if first["type"] == "extra_forbidden":
        return InvalidInput(f"{place}{name}: unknown key; {_hint(path)}")
    if first["type"] == "missing":
        return InvalidInput(f"{place}{name}: missing")
    reason = first["msg"].removeprefix("Value error, ").replace("Input should", "must")
    given = first["input"]
    value = "" if isinstance(given, dict | BaseModel) else f" = {given!r:.60}"
    return InvalidInput(f"{place}{name}{value}: {reason}" if path else f"{place}{reason}")


def _hint(path: tuple[str | int, ...]) -> str:
    model: type[BaseModel] = TrainingRecipe
    for part in path[:-1]:
        inner = model.model_fields[str(part)].annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            model = inner
    known = list(model.model_fields)
    close = get_close_matches(str(path[-1]), known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
