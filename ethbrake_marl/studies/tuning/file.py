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
    model_validator,
)

from ethbrake_marl.errors import InvalidInput
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


_Number = Annotated[int | float, PlainValidator(_check_number)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class Range(_Part):
    """From ``low`` to ``high``, both included; whole numbers where both are written without a point."""

    low: _Number
    high: _Number
    log: bool = False  # the logarithm is searched, not the number

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

    choices: Annotated[tuple[Any, ...], Field(strict=False, min_length=2)]

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

    worlds: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    seed: _Seed = 4007
    times: Annotated[int, Field(ge=1, le=1000)] = 10


class Pruning(_Part):
    """A trial stops whose least harm so far is beyond what the share ``keep`` of the finished ones had by then."""

    keep: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    after_trials: _Count = 5  # that have finished
    after_times: _Count = 3  # it was measured


class Sampling(_Part):
    """Who proposes: Optuna's TPE, or chance."""

    name: Literal["tpe", "random"] = "tpe"
    seed: _Seed = 0
    random_trials: _Count = 10  # before TPE begins


class TuningFile(_Part):
    """The whole file."""

    title: str = ""
    scenario: str
    recipe: str
    seed: _Seed = 0  # of every training
    settings: Annotated[dict[str, Any], AfterValidator(_check_keys)] = Field(default={}, alias="set")
    search: Annotated[dict[str, Dimension], Field(min_length=1), AfterValidator(_check_keys)]
    measure: Measuring = Measuring()
    prune: Pruning | None = Pruning()  # null: every trial is trained to its end
    sampler: Sampling = Sampling()
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
