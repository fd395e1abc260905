"""Strict YAML: every value with its line, and one way to write a number."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import ErrorDetails, PydanticCustomError
from pydantic_core.core_schema import NullableSchema, WithDefaultSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.store import parse_strict_json, read_plain

_NUMERAL = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def parse_numeral(text: str) -> float | None:
    """The number that ``text`` writes, infinite when it is too large; None when it writes none."""
    return float(text) if _NUMERAL.fullmatch(text) else None


_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_@./-]*(:[A-Za-z0-9_@./+-]+)*")
_RESERVED = {"null", "true", "false"}


def flow_text(value: Any, longest: int | None = None) -> str:
    """Write ``value`` in YAML's flow style; reading it back gives an equal value
    (of printable text, lists, mappings with text keys, finite or infinite numbers, true, false, null).

    A text longer than ``longest`` characters is cut (for messages only).
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


SIZE_LIMIT = 64 * 1024  # bytes
DEPTH_LIMIT = 16  # mappings and lists inside each other

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
    """What a file says, and on which line each of its values stands."""

    file: str
    content: Any  # dict, list, str, int, float, bool or None, nested
    lines: Mapping[YamlPath, int]  # from 1

    def line_of(self, path: YamlPath) -> int | None:
        """Line of the value at ``path``, or of the innermost value around it that the file has."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.lines:
                return self.lines[path[:length]]
        return None

    def where(self, path: YamlPath) -> str:
        """The file, and the line of ``line_of`` where there is one: how a message about ``path`` begins."""
        line = self.line_of(path)
        return self.file if line is None else f"{self.file}, line {line}"

    @contextmanager
    def refusing_at(self, path: YamlPath) -> Iterator[None]:
        """Begin the message of an ``InvalidInput`` from inside with where ``path`` stands."""
        try:
            yield
        except InvalidInput as error:
            raise type(error)(f"{self.where(path)}: {error}") from None


def read_yaml(path: str | Path, limit: int = SIZE_LIMIT) -> Document:
    """Read one YAML file of at most ``limit`` bytes.

    Raises ``InvalidInput`` with file, line, column and reason for every defect.
    """
    return parse_yaml(read_plain(path, limit), str(Path(path)), limit)


def parse_yaml(text: str | bytes, file: str = "<text>", limit: int = SIZE_LIMIT) -> Document:
    """Parse one YAML document; ``file`` is how messages call it. Raises as ``read_yaml``."""
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    if len(data) > limit:
        _fail(file, None, f"larger than {limit // 1024} KiB, the limit for these files")
    try:
        decoded = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        at = (before.count(b"\n"), error.start - before.rfind(b"\n") - 1)
        _fail(file, at, f"not UTF-8 text (byte 0x{data[error.start]:02x})")
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
    """Reads the content of one document from its events."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.lines, self.at = file, dict[YamlPath, int](), (0, 0)  # line and column of the event in hand
        self._events = yaml.parse(text, Loader=yaml.SafeLoader)

    def read(self) -> Any:
        """The value of the whole document; None where there is nothing."""
        content, documents = None, 0
        for event in iter(self._next, None):
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._fail("a second document starts here; one file holds one document")
                if event.tags or (event.version or (1, 2)) != (1, 2):
                    self._fail("directives are not supported here")
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
        """What begins with this event, at this path."""
        self._check_plain(event)
        self.lines.setdefault(path, self.at[0] + 1)
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if len(path) >= DEPTH_LIMIT:
            self._fail(f"nested deeper than {DEPTH_LIMIT} levels")
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
            self._fail(f"alias *{event.anchor} is not supported; write the value out")
        if event.anchor is not None:
            self._fail(f"anchor &{event.anchor} is not supported; write the value out where it is needed")
        if event.tag is not None:
            self._fail(f"tag {event.tag} is not supported; write a plain value")

    def _key(self, event: Any, before: Collection[str], path: YamlPath) -> str:
        if not isinstance(event, yaml.ScalarEvent):
            self._fail("a key must be text, not a list or a mapping")
        key = self._scalar(event)
        if event.implicit[0] and event.value == "<<":
            self._fail("merge key << is not supported; write the values out")
        if not isinstance(key, str):
            self._fail(f"key {event.value!r} must be text; quote it if that is what is meant")
        if key in before:
            self._fail(f"key {key!r} is given twice, first on line {self.lines[(*path, key)]}")
        return key

    def _scalar(self, event: yaml.ScalarEvent) -> str | int | float | bool | None:
        """Core schema of YAML 1.2; a quoted or block scalar is always text."""
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


# One clear message for whatever pydantic found: where, value, what would be right. No other file words its errors.

# Ending of a key -> the unit in words.
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
NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"


class FileModel(BaseModel):
    """What a file may say: unknown keys, other types and later changes are refused."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


Model = TypeVar("Model", bound=BaseModel)


UNSHOWN = object()  # a value that the message does not show


def refuse(at: YamlPath, value: Any, right: str) -> NoReturn:
    """Raise the error for ``value`` at ``at`` (inside the field being checked): ``right`` says what would do."""
    shown = "" if value is UNSHOWN else flow_text(value, 60)
    raise PydanticCustomError("refused", "{right}", {"right": right, "value": shown, "at": at})


def require(holds: bool, at: YamlPath, value: Any, right: str) -> None:
    """``refuse`` the value unless ``holds``."""
    if not holds:
        refuse(at, value, right)


class Wording:
    """What messages know of one kind of file: its keys by the fields of its model, and what a missing one needs."""

    def __init__(self, model: type[BaseModel], needed: str = "") -> None:
        self.model, self._needed = model, needed

    def known(self, path: YamlPath) -> list[str]:
        """The keys that may stand where ``path`` ends."""
        models = [self.model]
        for key in path[:-1]:
            inside = [model.model_fields[key].annotation for model in models if key in model.model_fields]
            models = [found for annotation in inside for found in _models_in(annotation)] or models
        return list(dict.fromkeys(f.alias or name for model in models for name, f in model.model_fields.items()))

    def needed(self, path: YamlPath) -> str:
        """What is needed at ``path``, where it is missing."""
        return self._needed

    def instead(self, key: str) -> str:
        """What there is in place of a key that such files do not have; empty where nothing is known of it."""
        return ""

    def owner(self, path: YamlPath) -> str:
        """Whose value stands at ``path``, in words; empty where that needs no saying."""
        return ""

    def right(self, detail: ErrorDetails) -> str:
        """What would be right, where only this kind of file knows; empty where the error says it itself."""
        return ""


def explain(document: Document, error: ValidationError, wording: Wording) -> InvalidInput:
    """The error where it does not fit its schema.

    The first is shown, unknown keys before all others, and "(and k more mistakes)" tells the rest. A missing
    key that an unknown one was probably meant to be is not counted.
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
    told = f" (and {more} more mistake{'s' * (more > 1)})" if more else ""
    return InvalidInput(f"{where}: {_describe(shown, path, wording)}{told}")


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def read_model(source: str | Path | Document, model: type[Model], wording: Wording, advice: str) -> Model:
    """What a file, or a document, says; raises ``InvalidInput`` with file, line, key, value and what would be right.

    ``advice`` says what must be there where it holds no mapping of keys to values.
    """
    document = source if isinstance(source, Document) else read_yaml(source)
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping {advice}")
    try:
        return model.model_validate(document.content)
    except ValidationError as error:
        raise explain(document, error, wording) from None


def read_json_model(data: bytes, model: type[Model]) -> tuple[Any, Model]:
    """The plain content of a JSON file that a program wrote, and what it says; raises ``ValueError`` in one line."""
    content = parse_strict_json(data)  # no key twice, no NaN
    try:
        return content, model.model_validate_json(data)
    except ValidationError as error:
        raise ValueError(str(first_mistake(error))) from None


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
    if detail["input"] != detail["input"]:  # NaN, which is not less than anything, either
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


# Settings of a command line, ``key.path=value``: parsed as YAML, and put in their place inside plain data.


@dataclass(frozen=True, slots=True)
class Override:
    """One setting: where, and which value."""

    text: str  # as it was given
    path: tuple[str, ...]  # keys from the outermost on; of a list: which entry, from 0
    value: Any  # typed by the rules of YAML

    @property
    def top(self) -> str:
        """The outermost key."""
        return self.path[0]

    @property
    def key(self) -> str:
        """The path as it was written."""
        return ".".join(self.path)

    def inside(self) -> Override:
        """The same without its outermost key."""
        return Override(self.text, self.path[1:], self.value)

    @staticmethod
    def parse(texts: Sequence[str]) -> list[Override]:
        """Parse ``key.path=value``, each key once; a value is YAML on one line: ``0.2`` or ``{uniform: [1, 2]}``.

        Raises ``InvalidInput`` for a text without ``=``, an empty key, a key given twice, and a value that is no YAML.
        """
        found: list[Override] = []
        for text in texts:
            key, equals, value = text.partition("=")
            path = tuple(part.strip() for part in key.split("."))
            if not equals or not all(path):
                raise InvalidInput(f"--set {text!r}: must be KEY=VALUE or KEY.KEY=VALUE, for instance gamma=0.99")
            if any(each.path == path for each in found):
                raise InvalidInput(f"--set {'.'.join(path)}: is given twice")
            found.append(Override(text, path, parse_yaml(value, f"--set {'.'.join(path)}").content))
        return found

    @staticmethod
    def put(content: Mapping[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
        """Outermost key -> its new value, of ``content`` with the overrides in it; ``content`` stays as it is.

        Raises ``InvalidInput`` for a path that leads into a value that holds nothing.
        """
        changed: dict[str, Any] = {}
        for override in overrides:
            top = override.top
            before = changed[top] if top in changed else copy.deepcopy(content.get(top))
            changed[top] = _placed(before, override.path[1:], override)
        return changed


def _placed(part: Any, path: tuple[str, ...], override: Override) -> Any:
    """``part`` with the value at ``path`` inside it."""
    if not path:
        return override.value
    key, rest = path[0], path[1:]
    if part is None:
        part = {}
    if isinstance(part, Mapping):
        return {**part, key: _placed(part.get(key), rest, override)}
    if isinstance(part, list | tuple):
        if not (key.isascii() and key.isdigit() and int(key) < len(part)):
            raise InvalidInput(f"--set {override.key}: {key!r} must be an entry from 0 to {len(part) - 1}")
        entries = list(part)
        entries[int(key)] = _placed(entries[int(key)], rest, override)
        return entries
    raise InvalidInput(f"--set {override.key}: there is nothing inside {flow_text(part, 60)}; set the whole value")


# JSON Schemas of files that people write, for editors that complete and check YAML while one types.

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class FileSchema(GenerateJsonSchema):
    """In a file a key that is not used is left out; it is never ``null``."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        """The schema of the value where there is one."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        """As always, but without ``"default": null``."""
        described = super().default_schema(schema)
        return {key: value for key, value in described.items() if key != "default" or value is not None}

    @staticmethod
    def publish(schema: dict[str, Any]) -> dict[str, Any]:
        """The schema as it is printed and shipped: with the dialect that it is written in, first."""
        return {"$schema": DIALECT, **schema}


def schema_lines(kind: str, command: str) -> str:
    """The comment by which a new file names its schema, ``scenario`` or ``recipe``, and the command that prints it."""
    return (
        f"# yaml-language-server: $schema={kind}.schema.json\n"
        "# Your editor completes and checks this file once that schema stands beside it:\n"
        f"#   ethbrake {command} > {kind}.schema.json\n"
    )
