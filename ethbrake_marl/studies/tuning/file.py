"""The YAML file of a tuning: a training, and the ranges of some of its recipe's settings."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    PrivateAttr,
    Tag,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.json_schema import publish
from ethbrake_marl.files.messages import Wording, explain
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml

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


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class Range(_Part):
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


class Choices(_Part):
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


class Measuring(_Part):
    """The list by which trials are judged and pruned, and how often in a training."""

    worlds: int = Field(default=1000, ge=1, le=1_000_000, description="of the list")
    seed: _Seed = Field(default=4007, description="of the list")
    times: int = Field(default=10, ge=1, le=1000, description="how often a training is measured")


class Pruning(_Part):
    """A trial stops whose least harm so far is beyond what the share ``keep`` of the finished ones had by then."""

    keep: float = Field(default=0.5, gt=0.0, lt=1.0, description="the share of finished trials to be as good as")
    after_trials: _Count = Field(default=5, description="so many finish before one is stopped")
    after_times: _Count = Field(default=3, description="nobody is stopped before it was measured so often")


class Sampling(_Part):
    """Who proposes: Optuna's TPE, or chance."""

    name: Literal["tpe", "random"] = Field(default="tpe", description="Optuna's TPE, or chance")
    seed: _Seed = Field(default=0, description="of what is proposed")
    random_trials: _Count = Field(default=10, description="trials by chance before TPE begins")


class TuningFile(_Part):
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
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping with scenario, recipe and search")
    try:
        found = TuningFile.model_validate(document.content)
    except ValidationError as error:
        raise explain(error, document, _TuningWording()) from None
    found._document = document
    return found


def tuning_json_schema() -> dict[str, Any]:
    """JSON Schema of the file of a tuning, for editors that complete and check YAML."""
    return publish({**TuningFile.model_json_schema(), "title": "Tuning"})


class _TuningWording(Wording):
    def known(self, path: YamlPath) -> list[str]:
        """The keys of the part in which ``path`` ends."""
        parts: dict[Any, type[BaseModel]] = {"measure": Measuring, "prune": Pruning, "sampler": Sampling}
        if len(path) > 2 and path[0] == "search":
            return [*Range.model_fields, *Choices.model_fields]
        model = parts.get(path[0], TuningFile) if len(path) > 1 else TuningFile
        return [field.alias or name for name, field in model.model_fields.items()]

    def needed(self, path: YamlPath) -> str:
        """Where an example stands."""
        return "it is needed; docs/tuning.md shows an example"
