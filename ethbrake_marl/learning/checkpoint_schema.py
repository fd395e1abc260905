"""The schema of a checkpoint's JSON files: their keys, types and bounds."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import TypedDict

from ethbrake_marl.files.messages import first_mistake
from ethbrake_marl.files.plain import parse_strict_json
from ethbrake_marl.learning.loop import EPISODE_COLUMNS
from ethbrake_marl.policies.manifest import Sha256

Count = Annotated[int, Field(ge=0, lt=2**63)]
Number = Annotated[int | float, Field(ge=-1e300, le=1e300)]
Seconds = Annotated[float, Field(strict=False, ge=0.0, allow_inf_nan=False)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class _ListedFile(_Part):
    bytes: Count
    sha256: Sha256


class Listing(_Part):
    """``checkpoint.json``: every other file of the checkpoint, and from where and when it is."""

    format: Literal["ethbrake-checkpoint"]
    format_version: Literal[1]
    steps: Count
    updates: Count
    versions: dict[str, str]
    files: dict[str, _ListedFile]


# The names of Stable-Baselines3's own counters begin with an underscore.
class _Counters(TypedDict):
    num_timesteps: Count
    _n_updates: Count
    _episode_num: Count
    _current_progress_remaining: Number
    _total_timesteps: Count


_Counters.__pydantic_config__ = ConfigDict(strict=True, extra="forbid")  # type: ignore[attr-defined]


class _Words(_Part):
    state: Annotated[int, Field(ge=0, lt=2**128)]
    inc: Annotated[int, Field(ge=0, lt=2**128)]


class _ActionGenerator(_Part):
    bit_generator: Literal["PCG64"]
    state: _Words
    has_uint32: Literal[0, 1]
    uinteger: Annotated[int, Field(ge=0, lt=2**32)]


class _Generators(_Part):
    numpy: tuple[Annotated[int, Field(ge=0, le=624)], Literal[0, 1], Number]
    python: tuple[Literal[3], Number | None]
    actions: _ActionGenerator


class _Replay(_Part):
    pos: Count | None = None
    full: bool | None = None


def _check_place(evaluation: dict[str, Number]) -> dict[str, Number]:
    for key in ("steps", "updates"):
        if not isinstance(evaluation.get(key), int):
            raise ValueError(f"{key} is missing or no whole number")
    return evaluation


class _Course(_Part):
    evaluations: list[Annotated[dict[str, Number], AfterValidator(_check_place)]]
    alarms: list[str]
    best_harm: Number | None
    wall_s: Seconds


def _every_column(ended: dict[str, list[Number]]) -> dict[str, list[Number]]:
    if ended.keys() != EPISODE_COLUMNS.keys():
        raise ValueError(f"the columns must be {', '.join(EPISODE_COLUMNS)}")
    return ended


class _Between(_Part):
    updates: Count
    ended: Annotated[dict[str, list[Number]], AfterValidator(_every_column)]
    course: _Course


class Numbers(_Part):
    """``state.json``: what ``capture_model``, ``BetweenUpdates.state`` and the session keep of a training."""

    training: Sha256  # which one, see ``Training.identity``
    counters: _Counters
    learning_rates: dict[str, Annotated[float, Field(strict=False, ge=0.0, le=1.0)]]
    random: _Generators
    log: dict[str, tuple[Number, Count, list[str]]]
    between: _Between
    replay: _Replay
    events: dict[str, Count]


def check_json(schema: type[Listing | Numbers], data: bytes) -> dict[str, Any]:
    """The content of a JSON file of a checkpoint; raises ``ValueError``, in one line, unless ``schema`` fits it."""
    content: dict[str, Any] = parse_strict_json(data)
    try:
        schema.model_validate_json(data)
    except ValidationError as error:
        raise ValueError(str(first_mistake(error))) from None
    return content
