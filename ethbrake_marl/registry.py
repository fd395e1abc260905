"""Names that stand for parts: agents, shields, measures, features, objectives, algorithms and commands.

One registry for each kind. A running program gives a name with ``register_...``; an installed package, ours among them,
with an entry point in its ``pyproject.toml``, which goes through the same function when the name is first used:

    [project.entry-points."ethbrake_marl.agents"]
    gentle = "my_package.agents:make_gentle"

So what is installed and not used is not imported, and cannot break what does not use it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
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

OURS = "ethbrake-marl"  # our own distribution
_VERSIONS: dict[str, str] = {}  # of the others that gave a part to this process

T = TypeVar("T")


class Part:
    """What an entry point names where it is more than a function or a class.

    It holds what the ``register_...`` function of its kind takes behind the name:

    >>> import ethbrake_marl as eb
    >>> def closing(episodes):
    ...     '''Largest closing speed of an impact in the line.'''
    >>> part = eb.Part(closing, unit="m/s")

    """

    def __init__(self, *given: Any, **settings: Any) -> None:
        self.given, self.settings = given, settings


@cache
def points(group: str) -> dict[str, list[EntryPoint]]:
    """The entry points of a group by name, ours first: several of a name where several distributions give it."""
    found: dict[str, list[EntryPoint]] = {}
    in_order = sorted(entry_points(group=f"ethbrake_marl.{group}"), key=lambda each: (giver(each) != OURS, each.name))
    for point in in_order:
        found.setdefault(point.name, []).append(point)
    return found


def giver(point: EntryPoint) -> str:
    """The distribution that gives an entry point."""
    return "?" if point.dist is None else point.dist.name


def versions_used() -> dict[str, str]:
    """Name -> version of the distributions, but ours, that gave a part to this process."""
    return dict(sorted(_VERSIONS.items()))


class Registry(Mapping[str, T]):
    """The parts of one kind by name, each loaded when it is first asked for.

    ``name in`` and going through the names load nothing. What is asked for raises ``InvalidInput`` where it cannot be
    loaded, or where two distributions give its name; ``MissingExtra`` where a package of an extra is missing.

    Args:
        kind: of its parts, in words.
        group: of its entry points, behind ``ethbrake_marl.``.
        register: is called with a name and what the entry point names, and puts it here with ``add``.
        built_in: parts that stand in the code beside it.

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
        """Those that are built in, those of entry points, then those that this process registered."""
        built_in = (name for name in self.loaded if name in self._built_in)
        return iter(dict.fromkeys([*built_in, *points(self.group), *self.loaded]))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> T:
        self.load(name)
        if name not in self.loaded:
            why = "is asked for while it is loaded" if name in self._loading else "stands for several of other names"
            raise InvalidInput(f"{self.kind} {name!r}: {why}")
        return self.loaded[name]

    def load(self, name: str) -> list[str]:
        """Load what has this name; raises ``UnknownName``. Gives the names of the parts that it stands for."""
        given = points(self.group).get(name, [])
        givers = [OURS] * (name in self._built_in) + [giver(point) for point in given]
        if len(givers) > 1:
            raise InvalidInput(
                f"{self.kind} {name!r}: the installed packages {' and '.join(givers)} give it; uninstall all but one"
            )
        if name in self.loaded or name in self._loading:
            return [name]
        if not given:
            raise self.unknown(name)
        self._loading.add(name)
        try:
            return self._load(name, given[0])
        finally:
            self._loading.discard(name)

    def _load(self, name: str, point: EntryPoint) -> list[str]:
        where = f"{self.kind} {name!r}, {point.value} of the installed package {giver(point)}"
        try:
            with naming_extras():
                found = point.load()
        except MissingExtra as error:
            raise MissingExtra(f"{self.kind} {name!r} {error}") from None
        except (Exception, SystemExit) as error:
            raise InvalidInput(f"{where}: cannot be imported: {describe_error(error)}") from error
        try:
            parts = found if isinstance(found, dict) else {name: found}  # several under one name are a mapping
            for each, part in parts.items():
                given, settings = (part.given, part.settings) if isinstance(part, Part) else ((part,), {})
                self._register(each, *given, **settings)
        except (EthBrakeError, TypeError) as error:
            raise InvalidInput(f"{where}: {error}") from error
        if point.dist is not None and giver(point) != OURS:
            _VERSIONS[giver(point)] = point.dist.version
        return list(parts)

    def add(self, name: str, part: T, is_same: Callable[[T], bool]) -> None:
        """Put a part here; raises ``AlreadyExists`` where another one has its name."""
        if name not in self.loaded and name in self and name not in self._loading:
            self.load(name)
        if not is_same(self.loaded.setdefault(name, part)):
            package = next((giver(point) for point in points(self.group).get(name, ()) if giver(point) != OURS), None)
            raise AlreadyExists(
                f"{self.kind} {name!r} is registered already; give another name"
                + f", or none in the package {package}, whose entry point gives it" * (package is not None)
            )

    def usable(self) -> dict[str, T]:
        """All that can be loaded, which is done; for lists that have to say more than names."""
        return {name: self.loaded[name] for name in self if self.why_not(name) is None and name in self.loaded}

    def why_not(self, name: str) -> str | None:
        """Why a name cannot be loaded; None if it is."""
        try:
            self.load(name)
        except (InvalidInput, MissingExtra) as error:
            return str(error)
        return None

    def unknown(self, name: object, known: Iterable[str] | None = None) -> UnknownName:
        """The error for a name that nothing has; ``known``: names to tell of in the place of all."""
        if not points("agents"):
            return UnknownName(
                f"unknown {self.kind} {name!r}: of the package {OURS} no entry points are installed; install it, or"
                " where these files are newer than its installation, install it again (make venv)"
            )
        return unknown_name(self.kind, name, self if known is None else known, may_be_own=True)
