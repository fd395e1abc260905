"""Strict reader of YAML files that records the line number of every value."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml
from pydantic import BaseModel

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_plain

_NUMERAL = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def parse_numeral(text: str) -> float | None:
    """Return the number that ``text`` represents (infinity if it is too large), or None if it is not a number."""
    return float(text) if _NUMERAL.fullmatch(text) else None


_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_@./-]*(:[A-Za-z0-9_@./+-]+)*")

_RESERVED = {"null", "true", "false"}


def flow_text(value: Any, longest: int | None = None) -> str:
    """Return ``value`` as text in YAML's flow style; reading the text gives an equal value.

    ``value`` may consist of printable texts, lists, mappings with text keys, numbers, true, false and null. For error
    messages, the text is cut off after ``longest`` characters.
    """
    text = _flow(value)
    return text if longest is None or len(text) <= longest else f"{text[: longest - 3]}..."


def _flow(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump(exclude_none=True)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(entry) for entry in value) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and value.lower() not in _RESERVED
        return value if plain else json.dumps(value, ensure_ascii=False)
    return _number(value) if isinstance(value, int | float) else repr(value)


def _number(value: int | float) -> str:
    if isinstance(value, int):
        return str(int(value)) if abs(value) < 2**63 else f"{str(value)[:24]}..."
    if abs(value) < 1e15 and value == int(value):
        return str(int(value))
    text = repr(float(value))
    return {"nan": ".nan", "inf": ".inf", "-inf": "-.inf"}.get(text, text)


SIZE_LIMIT = 64 * 1024  # largest accepted size of a file (bytes)

DEPTH_LIMIT = 16  # largest accepted depth of nested mappings and lists

# Keys and indices that lead to a value, such as ("roles", "vehicle_2"); () leads to the whole content.
YamlPath = tuple[str | int, ...]

_PLAIN_VALUES: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}

_INTEGER = re.compile(r"(?P<decimal>[-+]?[0-9]+)|0o(?P<octal>[0-7]+)|0x(?P<hexadecimal>[0-9a-fA-F]+)")

_BASES = {"decimal": 10, "octal": 8, "hexadecimal": 16}

_NOT_FINITE = re.compile(r"(?P<sign>[-+]?)\.(inf|Inf|INF)|\.(nan|NaN|NAN)")

_LARGEST_INTEGER = 2**63


@dataclass(frozen=True, slots=True)
class Document:
    """Content of a YAML file, and the line number of each value."""

    file: str  # path or name of the file, for error messages
    content: Any  # dict, list, str, int, float, bool or None, nested
    lines: Mapping[YamlPath, int]  # line number (from 1) of each value

    def line_of(self, path: YamlPath) -> int | None:
        """Return the line number (from 1) of the value at ``path``; None if no line is known.

        If the value does not exist, return the line of the innermost mapping or list around the path.
        """
        for length in range(len(path), -1, -1):
            if path[:length] in self.lines:
                return self.lines[path[:length]]
        return None

    def where(self, path: YamlPath) -> str:
        """Return file and line number of the value at ``path``, such as ``my.yaml, line 7``."""
        line = self.line_of(path)
        return self.file if line is None else f"{self.file}, line {line}"

    @contextmanager
    def refusing_at(self, path: YamlPath) -> Iterator[None]:
        """Context manager: if the block raises ``InvalidInput``, put ``where(path)`` in front of its message."""
        try:
            yield
        except InvalidInput as error:
            raise type(error)(f"{self.where(path)}: {error}") from None


def read_yaml(path: str | Path, limit: int = SIZE_LIMIT) -> Document:
    """Read a YAML file of at most ``limit`` bytes.

    Raises ``InvalidInput`` with file, line, column and reason if the file is not valid.
    """
    return parse_yaml(read_plain(path, limit), str(Path(path)), limit)


def parse_yaml(text: str | bytes, file: str = "<text>", limit: int = SIZE_LIMIT) -> Document:
    """Parse one YAML document (text or UTF-8 bytes) of at most ``limit`` bytes; ``file`` names it in error messages.

    Raises ``InvalidInput`` with file, line, column and reason if the document is not valid.
    """
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    if len(data) > limit:
        _fail(file, None, f"is larger than {limit // 1024} KiB, the limit for this kind of file")
    try:
        decoded = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        at = (before.count(b"\n"), error.start - before.rfind(b"\n") - 1)
        _fail(file, at, f"byte 0x{data[error.start]:02x} is not valid UTF-8 text")
    return _parse(decoded, file)


def _parse(text: str, file: str) -> Document:
    reader = _Reader(file, text)
    try:
        content = reader.read()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = (mark.line, mark.column) if mark is not None else None
        _fail(file, at, f"not valid YAML: {error.problem or error.context}")
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        at = (before.count("\n"), error.position - before.rfind("\n") - 1)
        _fail(file, at, f"not valid YAML: character #x{ord(text[error.position]):04x} is not allowed")
    except InvalidInput:
        raise
    except (yaml.YAMLError, RecursionError, ValueError, LookupError, AttributeError, TypeError) as error:
        _fail(file, reader.at, f"not valid YAML: {error}")
    return Document(file, content, reader.lines)


def _fail(file: str, at: tuple[int, int] | None, reason: str) -> NoReturn:
    where = file if at is None else f"{file}, line {at[0] + 1}, column {at[1] + 1}"
    raise InvalidInput(f"{where}: {reason}") from None


class _Reader:
    """Reader that builds the content of a document from YAML events."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.lines, self.at = file, dict[YamlPath, int](), (0, 0)  # line and column of the current event
        self._events = yaml.parse(text, Loader=yaml.SafeLoader)

    def read(self) -> Any:
        """Return the content of the whole document; None if it is empty."""
        content, documents = None, 0
        for event in iter(self._next, None):
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._fail("a second document starts here; a file must contain only one document")
                if event.tags or (event.version or (1, 2)) != (1, 2):
                    self._fail("YAML directives are not supported; remove them")
            elif isinstance(event, yaml.NodeEvent):
                content = self._value(event, ())
        return content

    def _next(self) -> Any:
        event = next(self._events, None)
        if event is not None and event.start_mark is not None:
            self.at = (event.start_mark.line, event.start_mark.column)
        return event

    def _fail(self, reason: str) -> NoReturn:
        _fail(self.file, self.at, reason)

    def _value(self, event: Any, path: YamlPath) -> Any:
        """Return the value at ``path``, whose first YAML event is ``event``."""
        self._check_plain(event)
        self.lines.setdefault(path, self.at[0] + 1)
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if len(path) >= DEPTH_LIMIT:
            self._fail(f"mappings and lists must not be nested more than {DEPTH_LIMIT} deep")
        if isinstance(event, yaml.SequenceStartEvent):
            entries: list[Any] = []
            while not isinstance(inner := self._next(), yaml.SequenceEndEvent):
                entries.append(self._value(inner, (*path, len(entries))))
            return entries
        values: dict[str, Any] = {}
        while not isinstance(inner := self._next(), yaml.MappingEndEvent):
            self._check_plain(inner)
            key = self._key(inner, values, path)
            self.lines[(*path, key)] = self.at[0] + 1
            values[key] = self._value(self._next(), (*path, key))
        return values

    def _check_plain(self, event: Any) -> None:
        if isinstance(event, yaml.AliasEvent):
            self._fail(f"alias *{event.anchor} is not supported; write the value itself")
        if event.anchor is not None:
            self._fail(f"anchor &{event.anchor} is not supported; write the value wherever it is needed")
        if event.tag is not None:
            self._fail(f"tag {event.tag} is not supported; write the value without a tag")

    def _key(self, event: Any, before: Collection[str], path: YamlPath) -> str:
        if not isinstance(event, yaml.ScalarEvent):
            self._fail("a key must be text, not a list or a mapping")
        key = self._scalar(event)
        if event.implicit[0] and event.value == "<<":
            self._fail("merge key << is not supported; write the keys and values themselves")
        if not isinstance(key, str):
            self._fail(f"key {event.value!r} must be text; if it is meant as text, put it in quotes")
        if key in before:
            self._fail(f"key {key!r} occurs twice; the first is on line {self.lines[(*path, key)]}")
        return key

    def _scalar(self, event: yaml.ScalarEvent) -> str | int | float | bool | None:
        """Convert a YAML scalar to a Python value by the core schema of YAML 1.2.

        A quoted or block scalar always becomes text.
        """
        text = str(event.value)
        if not event.implicit[0]:
            return text
        if text in _PLAIN_VALUES:
            return _PLAIN_VALUES[text]
        if integer := _INTEGER.fullmatch(text):
            return self._integer(integer)
        if (number := parse_numeral(text)) is not None:
            return number
        if special := _NOT_FINITE.fullmatch(text):
            sign = special["sign"]
            return float("nan") if sign is None else float(f"{sign}inf")
        return text

    def _integer(self, match: re.Match[str]) -> int:
        base = str(match.lastgroup)
        digits = match[base]
        value = int(digits, _BASES[base]) if len(digits) <= 64 else _LARGEST_INTEGER
        if not -_LARGEST_INTEGER < value < _LARGEST_INTEGER:
            self._fail(f"integer {digits[:24]}{'...' if len(digits) > 24 else ''} does not fit into 64 bits")
        return value
