"""One clear message for whatever pydantic found: where, value, what would be right. No other file words its errors."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, parse_numeral

# Ending of a key -> the unit in words.
UNITS = {
    "s": "seconds",
    "m": "metres",
    "mps": "metres per second",
    "mps2": "metres per second squared",
    "t": "tonnes",
}
_RIGHT = {
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number, written without a decimal point",
    "string_type": "must be text",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "model_attributes_type": "must be a mapping",
    "tuple_type": "must be a list",
    "string_pattern_mismatch": "must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or digit",
}


class Wording:
    """What messages know of the keys of one kind of file."""

    def known(self, path: YamlPath) -> list[str]:
        """The keys that may stand where ``path`` ends."""
        raise TypeError(f"{type(self).__name__} does not say which keys its files have")

    def needed(self, path: YamlPath) -> str:
        """What is needed at ``path``, where it is missing."""
        raise TypeError(f"{type(self).__name__} does not say what its files need")

    def instead(self, key: str) -> str:
        """What there is in place of a key that such files do not have; empty where nothing is known of it."""
        return ""

    def owner(self, path: YamlPath) -> str:
        """Whose value stands at ``path``, in words; empty where that needs no saying."""
        return ""

    def right(self, detail: ErrorDetails) -> str:
        """What would be right, where only this kind of file knows; empty where the error says it itself."""
        return ""


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
    where = document.file if absent else document.where(path)
    return InvalidInput(f"{where}: {_describe(shown, path, wording)}{f' (and {more} more)' if more else ''}")


class Mistake(NamedTuple):
    """The first defect that pydantic found in what no person wrote: as text ``place: right``."""

    place: str  # keys with dots between them; empty for the whole
    given: Any
    right: str

    def __str__(self) -> str:
        return f"{self.place}: {self.right}" if self.place else self.right


def first_mistake(error: ValidationError) -> Mistake:
    """Where the first mistake is, and what would be right: for files that programs write, and for settings in code."""
    detail = error.errors(include_url=False)[0]
    right = {"missing": "is missing", "extra_forbidden": "unknown key"}.get(detail["type"])
    if detail["type"] == "string_pattern_mismatch":  # not always that of a name, as in files that people write
        right = f"must match {detail['ctx']['pattern']}"
    return Mistake(".".join(str(key) for key in _path(detail)), detail["input"], right or _right(detail))


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
        hint = wording.instead(str(path[-1])) or suggestion(str(path[-1]), inside) or f"known: {', '.join(inside)}"
        return f"{place}: unknown key; {hint}"
    if detail["type"] == "missing":
        return f"{place}: missing; {wording.needed(path)}"
    ctx = detail.get("ctx", {})
    value = ctx["value"] if "value" in ctx else _show(detail)
    right = _unquote(detail) or wording.right(detail) or _right(detail)
    return f"{place}{f' = {value}' if value else ''}: {right}".removeprefix(": ")


def _show(detail: ErrorDetails) -> str:
    """The value, unless the whole file is meant; a number keeps the point that makes it wrong."""
    given = detail["input"]
    if isinstance(given, BaseModel) or not detail["loc"]:
        return ""
    return repr(given) if detail["type"] == "int_type" and isinstance(given, float) else flow_text(given, 60)


def _place(path: YamlPath, wording: Wording) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).removeprefix(".")
    owner = wording.owner(path)
    return f"{text} ({owner})" if owner else text


def _unquote(detail: ErrorDetails) -> str:
    """What would be right for a number in quotes; empty for anything else."""
    given = detail["input"]
    quoted = detail["type"] == "float_type" and isinstance(given, str) and parse_numeral(given) is not None
    return "must be a number, not text; write it without quotes" if quoted else ""


def _right(detail: ErrorDetails) -> str:
    kind = detail["type"]
    if kind == "float_type":
        return "must be a number"
    if kind == "too_long":
        return f"must have {detail['ctx']['max_length']} entries"
    if kind == "too_short":
        return "must not be empty"
    if kind == "literal_error":
        return f"must be {detail['ctx']['expected'].replace(chr(39), '')}"
    text = str(detail["msg"]).removeprefix("Value error, ")
    return _RIGHT.get(kind, text.replace("Input should", "must").replace("must be a valid", "must be a"))


def suggestion(key: str, known: Iterable[str]) -> str:
    """What an unknown ``key`` was probably meant to be; empty when nothing is close.

    A key that differs from a known one only in its unit is recognised as such: ``gaps_km``, ``mass``.
    """
    names = sorted(known)
    stems = {name.rsplit("_", 1)[0]: name for name in names if name.rsplit("_", 1)[-1] in UNITS}
    same = stems.get(key.rsplit("_", 1)[0]) or stems.get(key)
    close = [same] if same else get_close_matches(key, names, n=1)
    if not close:
        return ""
    unit = UNITS.get(close[0].rsplit("_", 1)[-1], "")
    return f"did you mean {close[0]}{f' ({unit})' if unit else ''}?"
