"""A strict reader of YAML files, which records the line number of every value."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_plain

_NUMERAL = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def parse_numeral(text: str) -> float | None:
    """Infinity if it is too large, None if it is not a number."""
    return float(text) if _NUMERAL.fullmatch(text) else None


_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_@./-]*(:[A-Za-z0-9_@./+-]+)*")

_RESERVED = {"null", "true", "false"}


def flow_text(value: Any, longest: int | None = None) -> str:
    """``value`` as YAML on one line (flow style). Parsing this text gives an equal value.

    ``longest``: largest length of the text, which is cut off for error messages; None: no limit.
    """
    text = _flow(value)
    return text if longest is None or len(text) <= longest else f"{text[: longest - 3]}..."


def _flow(value: Any) -> str:
    """Values of other types become their ``repr``."""
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


YAML_SIZE_LIMIT = 64 * 1024  # largest accepted size of a file (bytes)

DEPTH_LIMIT = 16  # largest accepted depth of nested mappings and lists

# Keys and indices that lead to a value, such as ("roles", "vehicle_2"); () leads to the whole content.
YamlPath = tuple[str | int, ...]

_LARGEST_INTEGER = 2**63

# Core schema of YAML 1.2: a plain scalar is the first of these that matches all of it, otherwise a text.
_PLAIN_VALUES: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+"), lambda text: int(text, 0)),
    (_NUMERAL, float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)


@dataclass(frozen=True, slots=True)
class Document:
    file: str  # path or name of the file, for error messages
    content: Any  # dict, list, str, int, float, bool or None, nested
    lines: Mapping[YamlPath, int]  # line number (from 1) of each value

    def where(self, path: YamlPath) -> str:
        """Such as ``my.yaml, line 7``; for a missing value, the line of its mapping."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.lines:
                return f"{self.file}, line {self.lines[path[:length]]}"
        return self.file

    @contextmanager
    def refusing_at(self, path: YamlPath) -> Iterator[None]:
        try:
            yield
        except InvalidInput as error:
            raise type(error)(f"{self.where(path)}: {error}") from None


def read_yaml(path: str | Path) -> Document:
    """Content of a YAML file of at most ``YAML_SIZE_LIMIT`` bytes.

    Raises ``InvalidInput`` with file, line, column and reason.
    """
    return parse_yaml(read_plain(path, YAML_SIZE_LIMIT), str(Path(path)))


def parse_yaml(text: str | bytes, file: str = "<text>") -> Document:
    """At most ``YAML_SIZE_LIMIT`` bytes. ``file``: name of the document in messages.

    Raises ``InvalidInput`` with file, line, column and reason.
    """
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    if len(data) > YAML_SIZE_LIMIT:
        raise InvalidInput(f"{file}: is larger than {YAML_SIZE_LIMIT // 1024} KiB, the limit for this kind of file")
    try:
        decoded = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InvalidInput(f"{file}, line {line}: byte 0x{data[error.start]:02x} is not valid UTF-8 text") from None
    content, lines = _parse(decoded, file)
    return Document(file, deepcopy(content), dict(lines))


@lru_cache(maxsize=128)
def _parse(text: str, file: str) -> tuple[Any, Mapping[YamlPath, int]]:
    """Both are cached (10 ms) and must not be changed."""
    lines: dict[YamlPath, int] = {}
    try:
        node = yaml.compose(text, Loader=_Loader)
        content = None if node is None else _value(node, (), lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        what = "" if isinstance(error, _Refused) else "not valid YAML: "
        raise InvalidInput(f"{file}{where}: {what}{error.problem or error.context}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        character = f"character #x{ord(text[error.position]):04x}"
        raise InvalidInput(f"{file}, line {line}: not valid YAML: {character} is not allowed") from None
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise InvalidInput(f"{file}: not valid YAML: {error}") from None
    return content, lines


class _Refused(yaml.MarkedYAMLError):
    """The error for valid YAML that this reader refuses."""


class _Loader(yaml.SafeLoader):
    """Refuses aliases, anchors, tags and deep nesting."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  # PyYAML's own are those of YAML 1.1
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        problem = ""
        if isinstance(event, yaml.AliasEvent):
            problem = f"alias *{event.anchor} is not supported; write the value itself"
        elif event.anchor is not None:
            problem = f"anchor &{event.anchor} is not supported; write the value wherever it is needed"
        elif event.tag is not None:
            problem = f"tag {event.tag} is not supported; write the value without a tag"
        elif self.depth >= DEPTH_LIMIT and not isinstance(event, yaml.ScalarEvent):
            problem = f"mappings and lists must not be nested more than {DEPTH_LIMIT} deep"
        if problem:
            raise _Refused(problem=problem, problem_mark=event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _value(node: yaml.Node, path: YamlPath, lines: dict[YamlPath, int]) -> Any:
    """Adds the line numbers of all values in the node to ``lines``."""
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node)
    if isinstance(node, yaml.SequenceNode):
        return [_value(entry, (*path, k), lines) for k, entry in enumerate(node.value)]
    values: dict[str, Any] = {}
    for head, entry in node.value:
        key = _scalar(head) if isinstance(head, yaml.ScalarNode) else None
        if not isinstance(key, str):
            problem = "a key must be text; if it is meant as text, put it in quotes"
            raise _Refused(problem=problem, problem_mark=head.start_mark)
        if key in values:
            problem = f"key {key!r} occurs twice; the first is on line {lines[(*path, key)]}"
            raise _Refused(problem=problem, problem_mark=head.start_mark)
        lines[(*path, key)] = head.start_mark.line + 1
        values[key] = _value(entry, (*path, key), lines)
    return values


def _scalar(node: yaml.ScalarNode) -> Any:
    """A quoted or block scalar is always text."""
    if node.style is not None:
        return str(node.value)
    value = next(
        (convert(node.value) for pattern, convert in _PLAIN_VALUES if pattern.fullmatch(node.value)), node.value
    )
    if isinstance(value, int) and not -_LARGEST_INTEGER < value < _LARGEST_INTEGER:
        raise _Refused(problem=f"integer {node.value:.24} does not fit into 64 bits", problem_mark=node.start_mark)
    return value
