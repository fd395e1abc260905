"""One clear message for whatever pydantic found in a YAML file: where, value, what would be right."""

from __future__ import annotations

from typing import Any, Protocol

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, parse_numeral
from ethbrake_marl.scenario.distributions import DISTRIBUTIONS
from ethbrake_marl.scenario.quantities import suggestion

_QUANTITY = (
    "must be a number, {uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}}"
    " or {choice: [a, b, ...]}"
)
_RIGHT = {
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number, written without a decimal point",
    "string_type": "must be text",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "model_attributes_type": "must be a mapping",
    "tuple_type": "must be a list",
    "string_pattern_mismatch": "must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or digit",
    "quantity": _QUANTITY,
}


class Wording(Protocol):
    """What messages know of the keys of one kind of file."""

    def known(self, path: YamlPath) -> list[str]:
        """The keys that may stand where ``path`` ends."""
        ...

    def needed(self, path: YamlPath) -> str:
        """What is needed at ``path``, where it is missing."""
        ...

    def owner(self, path: YamlPath) -> str:
        """Whose value stands at ``path``, in words; empty where that needs no saying."""
        ...


def explain(error: ValidationError, document: Document, wording: Wording) -> InvalidInput:
    """The error for a document that does not fit its schema.

    The first defect is shown, unknown keys before all others, and "(and k more)" counts the rest. A missing key
    that an unknown one was probably meant to be is not counted.
    """
    # A default that needs another field is not made after an error elsewhere: no defect of its own.
    details = [d for d in error.errors(include_url=False) if d["type"] != "default_factory_not_called"]
    unknown = [d for d in details if d["type"] == "extra_forbidden"]
    meant = " ".join(suggestion(str(d["loc"][-1]), wording.known(_path(d))) for d in unknown)
    rest = [d for d in details if d not in unknown and not (d["type"] == "missing" and f" {_path(d)[-1]}" in meant)]
    shown = (unknown + rest)[0]
    more = len(unknown) + len(rest) - 1
    path = _path(shown)
    absent = shown["type"] == "missing" and len(path) == 1
    line = None if absent else document.line_of(path)
    where = document.file if line is None else f"{document.file}, line {line}"
    return InvalidInput(f"{where}: {_describe(shown, path, wording)}{f' (and {more} more)' if more else ''}")


def _path(detail: ErrorDetails) -> YamlPath:
    """The path inside the file: without pydantic's tags, with the path inside the field that a check gave."""
    keys = tuple(key for key in detail["loc"] if not (isinstance(key, str) and key.startswith("#")))
    return (*keys, *detail.get("ctx", {}).get("at", ()))


def _describe(detail: ErrorDetails, path: YamlPath, wording: Wording) -> str:
    place = _place(path, wording)
    if detail["type"] == "extra_forbidden":
        inside = wording.known(path)
        if path[-1] in inside:
            return f"{place}: does not go with what stands beside it; a quantity has one distribution"
        hint = suggestion(str(path[-1]), inside) or f"known: {', '.join(inside)}"
        return f"{place}: unknown key; {hint}"
    if detail["type"] == "missing":
        return f"{place}: missing; {wording.needed(path)}"
    ctx = detail.get("ctx", {})
    value = ctx["value"] if "value" in ctx else _shown(detail)
    return f"{place}{f' = {value}' if value else ''}: {_right(detail)}".removeprefix(": ")


def _shown(detail: ErrorDetails) -> str:
    """The value, unless the whole file is meant; a number keeps the point that makes it wrong."""
    given = detail["input"]
    if isinstance(given, BaseModel) or not detail["loc"]:
        return ""
    return repr(given) if detail["type"] == "int_type" and isinstance(given, float) else flow_text(given, 60)


def _place(path: YamlPath, wording: Wording) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).removeprefix(".")
    owner = wording.owner(path)
    return f"{text} ({owner})" if owner else text


def _right(detail: ErrorDetails) -> str:
    kind, given = detail["type"], detail["input"]
    if kind == "float_type":
        quoted = isinstance(given, str) and parse_numeral(given) is not None
        return (
            "must be a number, not text; write it without quotes" if quoted else f"must be a number{_or_more(detail)}"
        )
    if kind == "too_long":
        return f"must have {detail['ctx']['max_length']} entries"
    if kind == "too_short":
        return "must not be empty"
    if kind == "literal_error":
        return f"must be {detail['ctx']['expected'].replace(chr(39), '')}"
    if kind == "quantity":
        return f"{_QUANTITY}{_misspelt(given)}"
    text = str(detail["msg"]).removeprefix("Value error, ")
    return _RIGHT.get(kind, text.replace("Input should", "must").replace("must be a valid", "must be a"))


def _or_more(detail: ErrorDetails) -> str:
    return " or a distribution, " + _QUANTITY.split(", ", 1)[1] if detail["loc"][-1] == "#number" else ""


def _misspelt(given: Any) -> str:
    hints = [suggestion(key, DISTRIBUTIONS) for key in given if isinstance(key, str)] if isinstance(given, dict) else []
    return "".join(f"; {hint}" for hint in hints if hint)
