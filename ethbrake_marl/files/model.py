"""Pydantic models of file contents, and the error message for the first mistake in a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from math import isnan
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import parse_strict_json
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, parse_numeral, read_yaml

# Suffix of a key -> unit in words.
UNITS = {
    "s": "seconds",
    "m": "metres",
    "mps": "metres per second",
    "mps2": "metres per second squared",
    "mps3": "metres per second cubed",
    "t": "tonnes",
}

_RIGHT = {
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number, written without a decimal point or an exponent",
    "string_type": "must be text",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "model_attributes_type": "must be a mapping",
    "tuple_type": "must be a list",
}

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"


class FileModel(BaseModel):
    """Immutable base class for the content of a file; unknown keys and wrong types are errors."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    @classmethod
    def key_fields(cls) -> Mapping[str, FieldInfo]:
        return cls.model_fields


Model = TypeVar("Model", bound=BaseModel)

UNSHOWN = object()  # passed as a value, means: do not show the value in the error message


def refuse(at: YamlPath, value: Any, right: str) -> NoReturn:
    """``at``: path of the value inside the validated field (``()``: the field itself). ``right``: what would be valid,
    such as ``must be above 0``.
    """
    value_text = "" if value is UNSHOWN else flow_text(value, 60)
    raise PydanticCustomError("refused", "{right}", {"right": right, "value": value_text, "at": at})


def require(holds: bool, at: YamlPath, value: Any, right: str) -> None:
    if not holds:
        refuse(at, value, right)


class Wording:
    """Subclasses override these parts of error messages. An empty text is left out."""

    def __init__(self, model: type[FileModel], needed: str = "") -> None:
        self.model, self._needed = model, needed

    def known(self, path: YamlPath) -> list[str]:
        models = [self.model]
        for key in path[:-1]:
            fields = [model.key_fields().get(str(key)) for model in models]
            inside = [field.annotation for field in fields if field is not None]
            models = [nested_model for annotation in inside for nested_model in models_in(annotation)] or models
        return list(dict.fromkeys(f.alias or name for model in models for name, f in model.key_fields().items()))

    def needed(self, path: YamlPath) -> str:
        return self._needed

    def instead(self, key: str) -> str:
        return ""

    def owner(self, path: YamlPath) -> str:
        return ""

    def right(self, detail: ErrorDetails) -> str:
        return ""


def explain(document: Document, error: ValidationError, wording: Wording) -> InvalidInput:
    """About the first unknown key, or else the first mistake that pydantic reports."""
    # A default that depends on an invalid field is no mistake of its own.
    details = [d for d in error.errors(include_url=False) if d["type"] != "default_factory_not_called"]
    detail = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    path = path_of(detail)
    absent = detail["type"] == "missing" and len(path) == 1
    return InvalidInput(f"{document.file if absent else document.where(path)}: {_describe(detail, path, wording)}")


def models_in(annotation: Any) -> Iterator[type[FileModel]]:
    if isinstance(annotation, type) and issubclass(annotation, FileModel):
        yield annotation
    for inner in get_args(annotation):
        yield from models_in(inner)


def read_model(source: str | Path | Document, model: type[Model], wording: Wording, advice: str) -> Model:
    """Raises ``InvalidInput`` for the first mistake.

    ``advice`` ends the message "must be a mapping ..." for a file without a mapping.
    """
    document = source if isinstance(source, Document) else read_yaml(source)
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping {advice}")
    try:
        return model.model_validate(document.content)
    except ValidationError as error:
        raise explain(document, error, wording) from None


def read_json_model(data: bytes, model: type[Model]) -> tuple[Any, Model]:
    """Content of a JSON file, as plain data and as ``model``. Raises ``ValueError`` with the reason on one line."""
    content = parse_strict_json(data)  # refuses repeated keys and NaN
    try:
        return content, model.model_validate_json(data)
    except ValidationError as error:
        raise ValueError(str(first_mistake(error))) from None


class Mistake(NamedTuple):
    place: str  # place of the mistake, keys joined by dots; empty if the data as a whole are invalid
    value: Any  # the invalid value
    right: str  # what would be valid

    def __str__(self) -> str:
        return f"{self.place}: {self.right}" if self.place else self.right


def first_mistake(error: ValidationError) -> Mistake:
    detail = error.errors(include_url=False)[0]
    right = {"missing": "is missing", "extra_forbidden": "is an unknown key"}.get(detail["type"])
    return Mistake(".".join(str(key) for key in path_of(detail)), detail["input"], right or _right(detail))


def path_of(detail: ErrorDetails) -> YamlPath:
    """Pydantic's tags of unions are removed. If ``refuse`` raised the error, its argument ``at`` is appended."""
    keys = tuple(key for key in detail["loc"] if not (isinstance(key, str) and key.startswith("#")))
    return (*keys, *detail.get("ctx", {}).get("at", ()))


def _describe(detail: ErrorDetails, path: YamlPath, wording: Wording) -> str:
    place = _place(path, wording)
    if detail["type"] == "extra_forbidden":
        inside = wording.known(path)
        if path[-1] in inside:
            return f"{place}: cannot be combined with the other keys here; a quantity has only one distribution"
        hint = wording.instead(str(path[-1])) or suggestion(str(path[-1]), inside) or f"known: {', '.join(inside)}"
        return f"{place}: unknown key; {hint}"
    if detail["type"] == "missing":
        return f"{place}: missing; {wording.needed(path)}"
    ctx = detail.get("ctx", {})
    value = ctx["value"] if "value" in ctx else _show(detail)
    right = _unquote(detail) or wording.right(detail) or _right(detail)
    return f"{place}{f' = {value}' if value else ''}: {right}".removeprefix(": ")


def _show(detail: ErrorDetails) -> str:
    """Empty for a whole file. A float where an integer is needed keeps its point."""
    value = detail["input"]
    if isinstance(value, BaseModel) or not detail["loc"]:
        return ""
    return repr(value) if detail["type"] == "int_type" and isinstance(value, float) else flow_text(value, 60)


def _place(path: YamlPath, wording: Wording) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).removeprefix(".")
    owner = wording.owner(path)
    return f"{text} ({owner})" if owner else text


def _unquote(detail: ErrorDetails) -> str:
    value = detail["input"]
    quoted = detail["type"] == "float_type" and isinstance(value, str) and parse_numeral(value) is not None
    return "must be a number, not text; write it without quotes" if quoted else ""


def _right(detail: ErrorDetails) -> str:
    kind = detail["type"]
    if isinstance(detail["input"], float) and isnan(detail["input"]):
        return "must be a finite number"
    if kind == "float_type":
        return "must be a number"
    if kind == "too_long":
        most = detail["ctx"]["max_length"]
        return f"must have {most if most == 2 else f'at most {most}'} entries"  # 2: a pair
    if kind == "too_short":
        least = detail["ctx"]["min_length"]
        return "must not be empty" if least == 1 else f"must have at least {least} entries"
    if kind == "string_pattern_mismatch":
        pattern = detail["ctx"]["pattern"]
        name = "must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or digit"
        return name if pattern == NAME_PATTERN else f"must match {pattern}"
    if kind == "literal_error":
        return f"must be {detail['ctx']['expected'].replace(chr(39), '')}"
    text = str(detail["msg"]).removeprefix("Value error, ")
    return _RIGHT.get(kind, text.replace("Input should", "must").replace("must be a valid", "must be a"))


def suggestion(key: str, known: Iterable[str]) -> str:
    """Empty if no known key is similar.

    A key with a wrong or missing unit, such as ``gaps_km`` or ``mass``, is also recognised.
    """
    names = sorted(known)
    stems = {name.rsplit("_", 1)[0]: name for name in names if name.rsplit("_", 1)[-1] in UNITS}
    same = next((name for stem, name in stems.items() if f"{key}_".startswith(f"{stem}_")), None)
    close = [same] if same else get_close_matches(key, names, n=1)
    if not close:
        return ""
    unit = UNITS.get(close[0].rsplit("_", 1)[-1], "")
    return f"did you mean {close[0]}{f' ({unit})' if unit else ''}?"
