"""Registries of agents, shields, measures, features, objectives, algorithms and commands, by name.

A running program adds an object with a ``register_...`` function. An installed package adds one with an entry point in
its ``pyproject.toml``:

    [project.entry-points."ethbrake_marl.agents"]
    gentle = "my_package.agents:make_gentle"

This package lists its own contents in tables instead, the ``contents.py`` of the core and of each extension. When a
name is first used, the entry point is loaded and its value is passed to the ``register_...`` function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from operator import attrgetter
from pkgutil import iter_modules
from threading import RLock
from typing import Any, TypeVar

from ethbrake_marl.errors import (
    AlreadyExists,
    EthBrakeError,
    InvalidInput,
    MissingExtra,
    UnknownName,
    describe_error,
    naming_extras,
    unknown_name,
)

DISTRIBUTION = "ethbrake-marl"  # name of this distribution
_LOCK = RLock()  # one thread at a time loads parts; their modules may look up others
_VERSIONS: dict[str, str] = {}  # distribution -> version of the other packages whose parts this process has loaded

T = TypeVar("T")


class Part:
    """Value of an entry point: all arguments of a ``register_...`` function except the name.

    In the group ``ethbrake_marl.measures``, an entry point NAME with the ``part`` below has the same effect as
    ``register_measure(NAME, closing, unit="m/s")``.

    >>> import ethbrake_marl as eb
    >>> def closing(game, alert, last):
    ...     '''Largest closing speed of an impact in the line.'''
    >>> part = eb.Part(closing, unit="m/s")
    """

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        self.arguments, self.settings = arguments, settings


@cache
def points(group: str) -> dict[str, list[EntryPoint]]:
    """By name, this package's first. Several packages may use one name."""
    by_name: dict[str, list[EntryPoint]] = {}
    foreign_points = [point for point in entry_points(group=f"ethbrake_marl.{group}") if giver(point) != DISTRIBUTION]
    for point in (
        *sorted(package_points(group), key=attrgetter("name")),
        *sorted(foreign_points, key=attrgetter("name")),
    ):
        by_name.setdefault(point.name, []).append(point)
    return by_name


def package_points(group: str) -> list[EntryPoint]:
    """Those in the modules ``contents``."""
    package = __name__.rpartition(".")[0]
    extensions = f"{package}.extensions"
    folders = [] if find_spec(extensions) is None else import_module(extensions).__path__
    names = [name for _, name, _ in iter_modules(folders) if "contents" in modules_in(folders, name)]
    part_points = []
    for place in (package, *(f"{extensions}.{name}" for name in names)):
        table = import_module(f"{place}.contents").CONTENTS.get(group, {})
        part_points += [EntryPoint(name, f"{place}.{value}", group) for name, value in table.items()]
    return part_points


def modules_in(folders: Iterable[str], name: str) -> list[str]:
    """Names of the modules of a package called ``name``, which is not imported."""
    return [module for _, module, _ in iter_modules([f"{folder}/{name}" for folder in folders])]


def giver(point: EntryPoint) -> str:
    return DISTRIBUTION if point.dist is None else point.dist.name


def versions_used() -> dict[str, str]:
    """Name -> version of other packages whose entry points this process has loaded."""
    return dict(sorted(_VERSIONS.items()))


class Registry(Mapping[str, T]):
    """Name -> object, for all objects of one kind. An object is loaded when its name is first looked up.

    Iterating, and testing whether a name exists, load nothing. Looking up a name raises ``UnknownName``,
    ``InvalidInput`` if the object cannot be loaded or two packages define it, and ``MissingExtra`` if an optional
    package is missing.

    Args:
        kind: noun for one object in messages, for example ``agent``.
        group: group of the entry points, without the prefix ``ethbrake_marl.``.
        register: function that is called with name and value of an entry point; it must call ``add`` of this registry.
        built_in: name -> object, for objects that are defined in code rather than by entry points.

    """

    def __init__(
        self, kind: str, group: str, register: Callable[..., None], built_in: Mapping[str, T] | None = None
    ) -> None:
        self.kind, self.group, self._register = kind, group, register
        self._built_in = frozenset(built_in or ())
        self._loading: set[str] = set()
        self.loaded: dict[str, T] = dict(built_in or {})

    def __contains__(self, name: object) -> bool:
        return name in self.loaded or name in points(self.group)

    def __iter__(self) -> Iterator[str]:
        built_in = (name for name in self.loaded if name in self._built_in)
        return iter(dict.fromkeys([*built_in, *points(self.group), *self.loaded]))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> T:
        self.load(name)
        if name not in self.loaded:
            loading = "is looked up by its own module while this module is loaded"
            why = loading if name in self._loading else "is an entry point that defines parts with other names"
            raise InvalidInput(f"{self.kind} {name!r} {why}")
        return self.loaded[name]

    def load(self, name: str) -> list[str]:
        """All names that its entry point defines: several if its value is a dictionary.

        Raises the errors of looking up a name.
        """
        candidates = points(self.group).get(name, [])
        if (name in self._built_in) + len(candidates) > 1:
            givers = [DISTRIBUTION] * (name in self._built_in) + [giver(point) for point in candidates]
            raise InvalidInput(
                f"{self.kind} {name!r} is defined by several installed packages, {' and '.join(givers)};"
                " uninstall all but one of them"
            )
        with _LOCK:
            if name in self.loaded or name in self._loading:  # by this thread
                return [name]
            if not candidates:
                raise self.unknown(name)
            self._loading.add(name)
            try:
                return self._load(name, candidates[0])
            finally:
                self._loading.discard(name)

    def _load(self, name: str, point: EntryPoint) -> list[str]:
        where = f"{self.kind} {name!r}, {point.value} of the installed package {giver(point)}"
        try:
            with naming_extras():
                value = point.load()
        except MissingExtra as error:
            raise MissingExtra(f"{self.kind} {name!r} {error}") from None
        except (Exception, SystemExit) as error:
            raise InvalidInput(f"{where}: cannot be imported: {describe_error(error)}") from error
        try:
            # An entry point that defines several parts is a dictionary of them.
            parts = value if isinstance(value, dict) else {name: value}
            for part_name, part in parts.items():
                arguments, settings = (part.arguments, part.settings) if isinstance(part, Part) else ((part,), {})
                self._register(part_name, *arguments, **settings)
        except (EthBrakeError, TypeError) as error:
            raise InvalidInput(f"{where}: {error}") from error
        if point.dist is not None and giver(point) != DISTRIBUTION:
            _VERSIONS[giver(point)] = point.dist.version
        return list(parts)

    def add(self, name: str, part: T, is_same: Callable[[T], bool]) -> None:
        """Raises ``AlreadyExists`` if another object has the name.

        ``is_same(existing)`` says whether the object that already has the name equals ``part``; then nothing is added.
        """
        names_others = False  # whether an entry point of this name defines parts with other names
        if name not in self.loaded and name in self and name not in self._loading:
            names_others = name not in self.load(name)
        if names_others or not is_same(self.loaded.setdefault(name, part)):
            package = next(
                (giver(point) for point in points(self.group).get(name, ()) if giver(point) != DISTRIBUTION), None
            )
            raise AlreadyExists(
                f"{self.kind} {name!r} is registered already; give another name"
                + f", or leave the registration to the entry point of the package {package}" * (package is not None)
            )

    def usable(self) -> dict[str, T]:
        """Without those that cannot be loaded."""
        return {name: self.loaded[name] for name in self if self.why_not(name) is None and name in self.loaded}

    def why_not(self, name: str) -> str | None:
        try:
            self.load(name)
        except (InvalidInput, MissingExtra) as error:
            return str(error)
        return None

    def unknown(self, name: object) -> UnknownName:
        return unknown_name(self.kind, name, self, may_be_own=True)
