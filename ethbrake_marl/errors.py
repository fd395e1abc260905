"""All exceptions of this package. Every message says what is wrong, where, and what would be right."""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec
from numbers import Integral
from pkgutil import resolve_name
from sysconfig import get_paths

_NAMED = 5  # largest number of failed worlds that a message lists one by one

LINE_LIMIT = 1_500  # characters of a message; a longer message is shortened in the middle

_KEPT_BEGINNING, _KEPT_END = 1_000, 400

_LIBRARIES = tuple(get_paths()[key] for key in ("stdlib", "platstdlib", "purelib", "platlib"))

_MOST_SUGGESTED = 3  # names that an error message suggests

NAMES = {  # kind -> place of its names, or of a function that lists them; imported only when an error needs them
    "agent": "ethbrake_marl.agent_names:AGENTS",
    "shield": "ethbrake_marl.agent_names:WRAPPERS",
    "scenario": "ethbrake_marl.worlds.catalogue:scenario_paths",
    "recipe": "ethbrake_marl.training.recipe:shipped_recipes",
}


def plain_text(text: str, keep: str = "") -> str:
    """Python escapes replace unprintable characters, so a name or path cannot move the terminal's cursor."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """Without its middle if it has more than ``LINE_LIMIT`` characters."""
    blanks = text if len(text) <= 2 * LINE_LIMIT else text[:LINE_LIMIT] + text[-LINE_LIMIT:]
    line = plain_text(blanks)
    if len(text) == len(blanks) and len(line) <= LINE_LIMIT:
        return line
    return f"{line[:_KEPT_BEGINNING]} ... ({len(text):,} characters) ... {line[-_KEPT_END:]}"


def count_of(n: int, thing: str) -> str:
    """Such as ``1 world`` or ``10,000 worlds``."""
    return f"{n:,} {thing}{'' if n == 1 else 's'}"


def describe_error(error: BaseException, path: str | None = None) -> str:
    """Short text about an exception from a user's code: class, message, and the line that raised it.

    ``path``: the user's file; the line is then the last one in the traceback that belongs to this file. None: the
    innermost line of code that is neither Python's own, nor an installed package's, nor this package's; without such
    code the innermost line of another package, or no line.
    """
    text = str(error) if isinstance(error, EthBrakeError) else f"{type(error).__name__}: {error}"
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError):
        where = "" if error.lineno is None else f"line {error.lineno}: "
        return f"{where}{type(error).__name__}: {error.msg}"
    if isinstance(error, FileNotFoundError) and not os.path.isabs(error.filename or os.sep):
        text += "; a relative path begins in the current folder"
    if path is not None:
        lines = [frame.lineno for frame in frames if frame.filename == path]
        return f"line {lines[-1]}: {text}" if lines else text
    outside = [frame for frame in frames if not frame.filename.startswith((os.path.dirname(__file__), "<frozen"))]
    if isinstance(error, EthBrakeError) or not outside:  # the call itself failed: wrong parameters
        return text
    of_user = [frame for frame in outside if not frame.filename.startswith(_LIBRARIES)]
    place = (of_user or outside)[-1]
    return f"{text} ({os.path.basename(place.filename)}, line {place.lineno})"


class EthBrakeError(Exception):
    """Base class of all errors that this package raises on purpose. The message is always one line.

    >>> import ethbrake_marl as eb
    >>> try:
    ...     eb.load_scenario("paper-randon")
    ... except eb.EthBrakeError as error:
    ...     print(error)
    unknown scenario 'paper-randon'; did you mean 'paper-random'?

    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InvalidInput(EthBrakeError, ValueError):
    """A value from the user cannot be used. The message names the argument, its value and what would be right."""


class UnknownName(InvalidInput):
    """A name (of a scenario, agent, key or run) is unknown. The message suggests a similar name or lists all names."""


class AlreadyExists(EthBrakeError, FileExistsError):
    """A file or a registered name already exists. With ``force`` (``--force``) a file is overwritten."""


class CorruptBundle(EthBrakeError, ValueError):
    """A policy bundle (the folder of a trained policy) is damaged, or a folder is no bundle. Nothing was loaded."""


EXTRA_OF = {
    **dict.fromkeys(("torch", "stable_baselines3", "supersuit", "tensorboard"), "train"),
    **dict.fromkeys(("matplotlib", "jinja2", "markupsafe"), "report"),
    **dict.fromkeys(("benchmarl", "torchrl", "tensordict", "hydra"), "marl"),
    **dict.fromkeys(("pandas", "pyarrow"), "data"),
    **dict.fromkeys(("pygame", "imageio_ffmpeg"), "render"),
    **dict.fromkeys(("ray", "joblib"), "cluster"),
    "optuna": "tune",
}


class MissingExtra(EthBrakeError, ImportError):
    """An optional package is not installed. The message contains the command that installs it.

    >>> import ethbrake_marl as eb
    >>> issubclass(eb.MissingExtra, ImportError)
    True

    """


@contextmanager
def naming_extras() -> Iterator[None]:
    """Context in which a failed import of an optional package raises ``MissingExtra``."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            raise
        raise _missing(package) from None


def need(package: str) -> None:
    """The check does not import the package."""
    if find_spec(package) is None:
        raise _missing(package)


def _missing(package: str) -> MissingExtra:
    pip = f"{sys.executable} -m pip install" if find_spec("pip") else f"uv pip install --python {sys.executable}"
    line = f"{pip} 'ethbrake-marl[{EXTRA_OF[package]}]'"
    return MissingExtra(f"needs the package {package}, which is not installed; install it with: {line}")


class PhysicsError(EthBrakeError, ArithmeticError):
    """Some worlds of a batch could not be simulated, because of a defect in the physics code.

    The other worlds are not affected. ``worlds``: world -> reason. A world is named by its number, or by its row in the
    batch if the caller supplied the worlds.
    """

    def __init__(self, worlds: Mapping[int, str]) -> None:
        super().__init__(worlds)
        self.worlds = dict(worlds)

    def __str__(self) -> str:
        named = [f"world {row}: {reason}" for row, reason in list(self.worlds.items())[:_NAMED]]
        more = len(self.worlds) - len(named)
        return one_line("; ".join([*named, f"and {count_of(more, 'more world')}"] if more else named))


class AgentFailed(InvalidInput):
    """A user's agent raised an exception or returned invalid actions.

    ``row``: number of the world, or its row in the batch if the caller supplied the worlds; None: unknown. ``reason``:
    what went wrong, and at which step.
    """

    def __init__(self, agent: str, row: int | None, reason: str) -> None:
        super().__init__(agent, row, reason)
        self.agent, self.row, self.reason = agent, row, reason

    def __str__(self) -> str:
        where = "" if self.row is None else f", world {self.row}"
        return one_line(f"agent {self.agent!r}{where}, {self.reason}")

    @staticmethod
    @contextmanager
    def naming(name: str, other_agents: Collection[str] = ()) -> Iterator[None]:
        """Context that names the agent, except for errors of ``other_agents``."""
        try:
            yield
        except AgentFailed as error:
            if error.agent in other_agents:
                raise
            raise AgentFailed(name, error.row, error.reason) from error


class Unfamiliar(UserWarning):
    """A trained policy, or a table of best known harm, was made for other worlds or physics, or for unknown ones."""


class CacheFault(UserWarning):
    """The cache of compiled physics code is damaged, or cannot be written, so code is compiled again."""


class NoLocks(UserWarning):
    """The file system of a folder has no locks, so nothing stops a second process from working in the folder."""


class IgnoredName(UserWarning):
    """The key ``name`` in a scenario's file differs from the name of the file, which counts."""


class FreeImpacts(UserWarning):
    """An objective gives some impact no weight, so causing this impact costs nothing."""


def unknown_name(kind: str, name: object, known: Iterable[str], *, may_be_own: bool = False) -> UnknownName:
    """Its message says what else has this name, or suggests similar names, or lists ``known``.

    ``may_be_own``: a message that lists names also says that a user's own part must be registered first.
    """
    names, text = sorted({*known}), name if isinstance(name, str) else ""
    longer = [known_name for known_name in names if known_name.startswith(text)]
    close = longer if len(longer) <= _MOST_SUGGESTED and longer else get_close_matches(text, names, n=1)
    advice = (
        f"; your own {kind} must be registered first, for instance by --load FILE.py (docs/extend.md)"
        if may_be_own
        else ""
    )
    hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"known: {', '.join(names) or 'none'}{advice}"
    first = re.split("[,:+@]", text)[0]
    tables = {other: resolve_name(place) for other, place in NAMES.items() if kind in NAMES and other != kind}
    if may_be_own and text.endswith(".py"):
        hint = f"write {text}:FUNCTION"
    others = [other for other, table in tables.items() if first in (table() if callable(table) else table)]
    if others:
        hint = f"{first!r} names another kind: {', '.join(others)}; were two values swapped?"
    return UnknownName(f"unknown {kind} {name!r}; {hint}")


def check_whole_number(what: str, value: object, least: int, most: int | None = None) -> None:
    """Raises ``InvalidInput`` outside [``least``, ``most``]."""
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not (is_whole and least <= value and (most is None or value <= most)):  # type: ignore[operator]  # whole
        right = f", at least {least}" if most is None else f" in {least}..{most}"
        raise InvalidInput(f"{what} = {value!r}: must be a whole number{right}")
