"""The YAML file of a tuning: a training, and the ranges of some of its recipe's settings."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    PlainValidator,
    PrivateAttr,
    Tag,
    WithJsonSchema,
    model_validator,
)

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plugins import noted_plugins
from ethbrake_marl.files.yaml import Document, FileModel, Wording, flow_text, publish, read_model, read_yaml
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe, read_settings
from ethbrake_marl.learning.training import Training, resolve, training_content
from ethbrake_marl.policies.actor import installed_versions
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs import load_parts, refused_part

_Seed = Annotated[int, Field(ge=0, lt=2**32)]
_Count = Annotated[int, Field(ge=0, le=1_000_000)]


def _check_number(value: Any) -> int | float:
    """A whole number stays one: it says that whole numbers alone are tried."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError("must be a number")
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


_Number = Annotated[int | float, PlainValidator(_check_number), WithJsonSchema({"type": "number"})]


class Range(FileModel):
    """From ``low`` to ``high``, both included; whole numbers where both are written without a point."""

    low: _Number = Field(description="the least value, included")
    high: _Number = Field(description="the largest value, included; with low: whole numbers where neither has a point")
    log: bool = Field(default=False, description="the logarithm is searched, not the number")

    def __str__(self) -> str:
        """The range in words."""
        kind = ", whole" * self.whole + ", by its logarithm" * self.log
        return f"from {flow_text(self.low)} to {flow_text(self.high)}{kind}"

    @property
    def whole(self) -> bool:
        """Whether whole numbers alone are tried."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @model_validator(mode="after")
    def _in_order(self) -> Range:
        if not self.low < self.high:
            raise ValueError(f"low {flow_text(self.low)} must be less than high {flow_text(self.high)}")
        if self.log and not self.low > 0:
            raise ValueError(f"low {flow_text(self.low)} must be greater than 0, for its logarithm is searched")
        return self


class Choices(FileModel):
    """One of a list of values, of any kind."""

    choices: tuple[Any, ...] = Field(strict=False, min_length=2, description="values of any kind that the recipe takes")

    def __str__(self) -> str:
        """The values in words."""
        return f"one of {', '.join(flow_text(value) for value in self.choices)}"

    @model_validator(mode="after")
    def _once_each(self) -> Choices:
        texts = [flow_text(value) for value in self.choices]
        twice = [text for k, text in enumerate(texts) if text in texts[:k]]
        if twice:
            raise ValueError(f"{twice[0]} stands there twice")
        return self


def _form(value: Any) -> str:
    return "#choices" if isinstance(value, Choices) or (isinstance(value, dict) and "choices" in value) else "#range"


Dimension = Annotated[
    Annotated[Range, Tag("#range")] | Annotated[Choices, Tag("#choices")],
    Discriminator(_form),
]


def _check_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if not key or "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: must be a key of the recipe, with dots inside a part")
    return value


class Measuring(FileModel):
    """The list by which trials are judged and pruned, and how often in a training."""

    worlds: int = Field(default=1000, ge=1, le=1_000_000, description="of the list")
    seed: _Seed = Field(default=4007, description="of the list")
    times: int = Field(default=10, ge=1, le=1000, description="how often a training is measured")


class Pruning(FileModel):
    """A trial stops whose least harm so far is beyond what the share ``keep`` of the finished ones had by then."""

    keep: float = Field(default=0.5, gt=0.0, lt=1.0, description="the share of finished trials to be as good as")
    after_trials: _Count = Field(default=5, description="so many finish before one is stopped")
    after_times: _Count = Field(default=3, description="nobody is stopped before it was measured so often")


class Sampling(FileModel):
    """Who proposes: Optuna's TPE, or chance."""

    name: Literal["tpe", "random"] = Field(default="tpe", description="Optuna's TPE, or chance")
    seed: _Seed = Field(default=0, description="of what is proposed")
    random_trials: _Count = Field(default=10, description="trials by chance before TPE begins")


class TuningFile(FileModel):
    """The whole file."""

    title: str = Field(default="", description="one line, for you")
    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: _Seed = Field(default=0, description="of every training")
    settings: Annotated[dict[str, Any], AfterValidator(_check_keys)] = Field(
        default={}, alias="set", description="settings of every trial, as train --set"
    )
    search: Annotated[dict[str, Dimension], AfterValidator(_check_keys)] = Field(
        min_length=1, description="the space: a dotted key of the recipe, with a range or a list of choices"
    )
    measure: Measuring = Field(default=Measuring(), description="the list on which trials are judged, and how often")
    prune: Pruning | None = Field(default=Pruning(), description="when a trial is given up; null: never")
    sampler: Sampling = Field(default=Sampling(), description="who proposes")
    _document: Document = PrivateAttr(Document("the tuning", {}, {}))  # where it stands, for messages

    def refusing_at(self, *path: str | int) -> AbstractContextManager[None]:
        """Begin the message of an ``InvalidInput`` from inside with file and line of what stands at ``path``."""
        return self._document.refusing_at(path)


def read_tuning(path: str | Path) -> TuningFile:
    """Read the file of a tuning; raises ``InvalidInput`` with file, line, key, value and what would be right."""
    document = read_yaml(path)
    wording = Wording(TuningFile, "it is needed; docs/tuning.md shows an example")
    found = read_model(document, TuningFile, wording, "with scenario, recipe and search")
    found._document = document
    return found


def tuning_json_schema() -> dict[str, Any]:
    """JSON Schema of the file of a tuning, for editors that complete and check YAML."""
    return publish({**TuningFile.model_json_schema(), "title": "Tuning"})


# A tuning, resolved: the training that every trial changes, and a search space all of which can be trained.

Values = Mapping[str, Any]  # of a trial: key -> value, as YAML has it

_NOT_SEARCHED = {  # key -> why; what is inside it, too
    "seed": "a seed is luck; give one for all trials, as seed",
    "evaluation": "trials are judged on one list; give it as measure",
    "algorithm": "each algorithm has a recipe of its own; tune one at a time",
    "total_steps": "every trial gets the same number of decisions; give it in set",
    "checkpoint_every_updates": "it changes no result",
    "reward.harm_count": "it says which harm is least; give it in set",
}
_NOT_SET = ("seed", "evaluation")
_TRIED = 200  # points of the space that are checked before anything starts


@dataclass(frozen=True)
class TuningPlan:
    """What every trial has in common."""

    file: TuningFile
    recipe: TrainingRecipe  # with the file's settings, its seed and its list
    scenario: Scenario
    identity: str  # SHA-256 of all that makes a trial's harm what it is, versions and plug-ins included

    def training(self, values: Values) -> Training:
        """The training of a trial; raises ``InvalidInput`` where the values do not go together."""
        given = read_settings(texts_of(values), [self.recipe])
        recipe = self._measured(given.change(self.recipe))
        return resolve(recipe, self.scenario)

    def updates(self, recipe: TrainingRecipe) -> int:
        """Updates of a whole training."""
        return -(-recipe.total_steps // (recipe.n_envs * len(self.scenario.learners) * recipe.rounds))

    def own_values(self) -> dict[str, Any] | None:
        """The values that the recipe has, None where one of them is not in the space."""
        content = self.recipe.model_dump(mode="json")
        own = {key: _as_searched(dimension, _value_at(content, key)) for key, dimension in self.file.search.items()}
        return None if None in own.values() else own

    def _measured(self, recipe: TrainingRecipe) -> TrainingRecipe:
        """The recipe with the tuning's list, measured so often that all trials can be compared on the way."""
        asked = self.file.measure
        every = -(-self.updates(recipe) // asked.times)
        return recipe.replace(evaluation={"every_updates": every, "worlds": asked.worlds, "seed": asked.seed})


def plan_tuning(file: TuningFile) -> TuningPlan:
    """Resolve the file and try its space.

    Raises ``InvalidInput``: an unknown scenario or recipe, a key that the recipe does not have or that is not to be
    searched, a value that it does not allow, values that do not go together.
    """
    with file.refusing_at("recipe"):
        recipe = load_recipe(file.recipe)
    for key in file.search:
        with file.refusing_at("search", key):
            _check_searched(key, recipe, file)
    scenario, changed = _set_parts(file)
    with file.refusing_at("scenario"):
        resolve(changed, scenario)
    content = training_content(changed, scenario)
    told = {"training": content, **file.model_dump(mode="json", include={"search", "measure", "prune", "sampler"})}
    told |= {"order": [*file.search], "versions": installed_versions(), "plugins": noted_plugins()}
    identity = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    plan = TuningPlan(file, changed, scenario, identity)
    _check_space(plan)
    return plan


def texts_of(values: Values) -> tuple[str, ...]:
    """The values as ``KEY=VALUE``."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())


def _check_searched(key: str, recipe: TrainingRecipe, file: TuningFile) -> None:
    bare = key.removeprefix("recipe.")
    for inner, reason in _NOT_SEARCHED.items():
        if bare == inner or bare.startswith(f"{inner}."):
            raise InvalidInput(f"search.{key}: is not searched: {reason}")
    for other in (*file.settings, *(each for each in file.search if each != key)):
        if f"{bare}.".startswith(f"{other.removeprefix('recipe.')}."):
            raise InvalidInput(f"search.{key}: {other} stands there too; leave one of them out")
    if read_settings([f"{key}=0"], [recipe]).scenario:
        raise InvalidInput(
            f"search.{key}: is the scenario's; a search changes the recipe, so that harms can be compared"
        )


def _set_parts(file: TuningFile) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe with what the file sets."""
    for key in file.settings:
        with file.refusing_at("set", key):
            if key.removeprefix("recipe.").partition(".")[0] in _NOT_SET:
                raise InvalidInput(f"set.{key}: is no setting here; give seed and measure beside it")
    asked = file.scenario, file.recipe, texts_of(file.settings)
    try:
        scenario, recipe = load_parts(*asked)
    except InvalidInput:
        part = refused_part(*asked)
        with file.refusing_at(*(("set", part) if part in file.settings else (part or "set",))):
            raise
    return scenario, recipe.replace(seed=file.seed)


def _check_space(plan: TuningPlan) -> None:
    """Raise ``InvalidInput`` for an end that the recipe does not allow, and for ends or points that do not fit."""
    for key, dimension in plan.file.search.items():
        with plan.file.refusing_at("search", key):
            _check_dimension(plan, key, dimension)
    with plan.file.refusing_at("search"):
        for point in _points(plan):
            _check_point(plan, point)


def _check_dimension(plan: TuningPlan, key: str, dimension: Range | Choices) -> None:
    own = _value_at(plan.recipe.model_dump(mode="json"), key)
    if isinstance(dimension, Range) and not dimension.whole and type(own) is int:
        try:
            plan.training({key: math.nextafter(dimension.low, math.inf)})
        except InvalidInput:
            written = f"{{low: {dimension.low!r}, high: {dimension.high!r}}}"  # with the points that make it wrong
            right = "must be whole numbers, written without a decimal point"
            raise InvalidInput(f"search.{key} = {written}: {right}") from None
    for value in _ends(dimension):
        _check_point(plan, {key: value})


def _check_point(plan: TuningPlan, values: Values) -> None:
    try:
        plan.training(values)
    except InvalidInput as error:
        raise InvalidInput(f"search, at {', '.join(texts_of(values))}: {error}") from None


def _points(plan: TuningPlan) -> Iterator[dict[str, Any]]:
    """All low, all high, and points by chance, the same ones each time."""
    search = plan.file.search
    for end in (0, -1):
        yield {key: _ends(dimension)[end] for key, dimension in search.items()}
    random = np.random.default_rng(0)
    for _ in itertools.repeat(None, _TRIED):
        yield {key: _draw(dimension, random) for key, dimension in search.items()}


def _ends(dimension: Range | Choices) -> tuple[Any, ...]:
    return dimension.choices if isinstance(dimension, Choices) else (dimension.low, dimension.high)


def _draw(dimension: Range | Choices, random: np.random.Generator) -> Any:
    if isinstance(dimension, Choices):
        return dimension.choices[int(random.integers(len(dimension.choices)))]
    if dimension.whole:
        return int(random.integers(int(dimension.low), int(dimension.high), endpoint=True))
    low, high = float(dimension.low), float(dimension.high)
    return min(low * (high / low) ** random.random(), high) if dimension.log else float(random.uniform(low, high))


def _as_searched(dimension: Range | Choices, value: Any) -> Any:
    """The value as the dimension has it; None where it is not in it."""
    if isinstance(dimension, Choices):
        return next((each for each in dimension.choices if flow_text(each) == flow_text(value)), None)
    if not isinstance(value, int | float) or isinstance(value, bool) or not dimension.low <= value <= dimension.high:
        return None
    if not dimension.whole:
        return float(value)
    return int(value) if value == int(value) else None


def _value_at(content: Any, key: str) -> Any:
    """What stands at a dotted key; None where nothing does."""
    for part in key.removeprefix("recipe.").split("."):
        if isinstance(content, list) and part.isdecimal() and int(part) < len(content):
            content = content[int(part)]
        elif isinstance(content, Mapping):
            content = content.get(part)
        else:
            return None
    return content
