"""One family of exceptions. Every message says what is wrong, where, and what would be right."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec
from numbers import Integral
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_NAMED = 5  # failed worlds that a message names one by one

LINE_LIMIT = 1_500  # characters of a message; of a longer one the beginning and the end are shown

_KEPT_BEGINNING, _KEPT_END = 1_000, 400


def plain_text(text: str, keep: str = "") -> str:
    """``text`` as a terminal may have it: what is not printable is written as in Python's own escapes.

    That is every control, direction and separator character but the blank and those in ``keep``. Names, keys and paths
    come from files and command lines: shown as they are, they could move the cursor or turn a line around.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """``text`` as one line of at most ``LINE_LIMIT`` characters of ``plain_text``, its middle left out if need be.

    A message begins with where and what, and ends with what would be right.
    """
    blanks = text if len(text) <= 2 * LINE_LIMIT else text[:LINE_LIMIT] + text[-LINE_LIMIT:]
    line = plain_text(blanks)
    if len(text) == len(blanks) and len(line) <= LINE_LIMIT:
        return line
    return f"{line[:_KEPT_BEGINNING]} ... ({len(text):,} characters) ... {line[-_KEPT_END:]}"


def count_of(n: int, thing: str) -> str:
    """A number and what it counts, as a message has it: ``1 world``, ``10,000 worlds``."""
    return f"{n:,} {thing}{'' if n == 1 else 's'}"


def describe_error(error: BaseException, path: str | None = None) -> str:
    """An exception of somebody's code in a few words, and the last line that was run, of the file at ``path`` if given.

    Ours speak for themselves.
    """
    text = str(error) if isinstance(error, EthBrakeError) else f"{type(error).__name__}: {error}"
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError):
        where = "" if error.lineno is None else f"line {error.lineno}: "
        return f"{where}{type(error).__name__}: {error.msg}"
    if path is not None:
        lines = [frame.lineno for frame in frames if frame.filename == path]
        return f"line {lines[-1]}: {text}" if lines else text
    if isinstance(error, EthBrakeError) or not frames:
        return text
    if frames[-1].filename.startswith(os.path.dirname(__file__)):  # it was not even called: other parameters
        return text
    return f"{text} ({os.path.basename(frames[-1].filename)}, line {frames[-1].lineno})"


class EthBrakeError(Exception):
    """Base of every error that this package raises on purpose; its text is one line, whatever it tells of.

    >>> import ethbrake_marl as eb
    >>> try:
    ...     eb.load_scenario("paper-randon")
    ... except eb.EthBrakeError as error:
    ...     print(error)
    unknown scenario 'paper-randon'; did you mean 'paper-random'?

    """

    def __str__(self) -> str:
        """The message as ``one_line``."""
        return one_line(super().__str__())


class InvalidInput(EthBrakeError, ValueError):
    """A value given by the user cannot be used: the message names it, its value and what would be right."""


class UnknownName(InvalidInput):
    """A name (scenario, agent, key, run) is not known; the message lists or suggests those that are."""


class AlreadyExists(EthBrakeError, FileExistsError):
    """Something would be overwritten; pass ``force`` (``--force``) to allow it."""


class CorruptBundle(EthBrakeError, ValueError):
    """A policy bundle is damaged, or is not one; nothing of it was used."""


_EXTRA_OF = {
    **dict.fromkeys(("torch", "stable_baselines3", "supersuit", "tensorboard"), "train"),
    **dict.fromkeys(("benchmarl", "torchrl", "tensordict", "hydra"), "marl"),
    **dict.fromkeys(("onnx", "onnxruntime"), "export"),
    **dict.fromkeys(("pyarrow", "minari", "h5py"), "data"),
    **dict.fromkeys(("pygame", "imageio_ffmpeg"), "render"),
    **dict.fromkeys(("ray", "optuna", "joblib"), "cluster"),
    "libsumo": "sumo",
}


class MissingExtra(EthBrakeError, ImportError):
    """Something needs a package that the plain install leaves out; the message holds the line that installs it.

    >>> import ethbrake_marl as eb
    >>> issubclass(eb.MissingExtra, ImportError)
    True

    """


@contextmanager
def naming_extras() -> Iterator[None]:
    """An import inside that lacks a package of an extra raises ``MissingExtra``; any other fails as it would."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRA_OF:
            raise
        raise _missing(package) from None


def need(package: str) -> None:
    """Raise ``MissingExtra`` unless a package of an extra is installed; nothing is imported."""
    if find_spec(package) is None:
        raise _missing(package)


def _missing(package: str) -> MissingExtra:
    line = f"{sys.executable} -m pip install 'ethbrake-marl[{_EXTRA_OF[package]}]'"
    return MissingExtra(f"needs the package {package}, which is not installed: {line}")


class PhysicsError(EthBrakeError, ArithmeticError):
    """Some worlds of a batch could not be advanced: a defect of the kernel, never of the input.

    ``worlds``: what is wrong, by the world's row in the batch that was given. All others are well, and a world's result
    does not depend on its batch: who has a list may leave these out and go on (``physics.leaving_out_failed``).
    """

    def __init__(self, worlds: Mapping[int, str]) -> None:
        super().__init__(worlds)
        self.worlds = dict(worlds)

    def __str__(self) -> str:
        named = [f"world {row}: {reason}" for row, reason in list(self.worlds.items())[:_NAMED]]
        more = len(self.worlds) - len(named)
        return one_line("; ".join([*named, f"and {count_of(more, 'more world')}"] if more else named))

    def renumbered(self, rows: Sequence[int] | NDArray[np.int64]) -> PhysicsError:
        """The same of the batch from which the worlds of this one were taken: world k was its world ``rows[k]``."""
        return PhysicsError({int(rows[row]): reason for row, reason in self.worlds.items()})


class AgentFailed(InvalidInput):
    """An agent that somebody gave us raised an exception, or gave no actions; the message names world and step.

    ``row``: of the world in the batch that was given; None where it is not known.
    """

    def __init__(self, agent: str, row: int | None, reason: str) -> None:
        super().__init__(agent, row, reason)
        self.agent, self.row, self.reason = agent, row, reason

    def __str__(self) -> str:
        where = "" if self.row is None else f", world {self.row}"
        return one_line(f"agent {self.agent!r}{where}, {self.reason}")

    def renumbered(self, rows: Sequence[int] | NDArray[np.int64]) -> AgentFailed:
        """The same of the batch from which the worlds of this one were taken, as ``PhysicsError.renumbered``."""
        return AgentFailed(self.agent, None if self.row is None else int(rows[self.row]), self.reason)

    @staticmethod
    @contextmanager
    def naming(name: str, others: Collection[str] = ()) -> Iterator[None]:
        """Name an agent that fails inside the block as the user does: on the command line, or in a mapping.

        ``others``: names of who drives the other vehicles, which stay.
        """
        try:
            yield
        except AgentFailed as error:
            if error.agent in others:
                raise
            raise AgentFailed(name, error.row, error.reason) from error


class Unfamiliar(UserWarning):
    """A trained policy drives in worlds beyond those that it was trained in."""


@contextmanager
def renumbered(rows: Sequence[int] | NDArray[np.int64]) -> Iterator[None]:
    """Worlds that fail inside are told by the rows of the batch from which they were taken."""
    try:
        yield
    except (PhysicsError, AgentFailed) as error:
        raise error.renumbered(rows) from error


class UncertifiedStep(EthBrakeError):
    """An engine that a shield follows was made to do something else than was certified; the step was not made."""


def unknown_name(kind: str, name: object, known: Iterable[str], *, may_be_own: bool = False) -> UnknownName:
    """Build the error for an unknown ``name``, with a suggestion when one is close.

    ``may_be_own``: users have some of their own, so that a package may not be installed.
    """
    names = sorted(known)
    close = get_close_matches(name, names, n=1) if isinstance(name, str) else []
    own = "; one of your own must be registered or installed first (docs/extending.md)" if may_be_own else ""
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names) or 'none'}{own}"
    return UnknownName(f"unknown {kind} {name!r}; {hint}")


def check_whole_number(what: str, value: object, least: int, most: int | None = None) -> None:
    """Raise ``InvalidInput`` unless ``value`` is a whole number from ``least`` to ``most`` (None: no end)."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not (whole and least <= value and (most is None or value <= most)):  # type: ignore[operator]  # whole
        right = f", at least {least}" if most is None else f" in {least}..{most}"
        raise InvalidInput(f"{what} = {value!r}: must be a whole number{right}")


def check_one_learner(scenario: str, learners: Sequence[str], advice: str) -> None:
    """Raise ``InvalidInput``, ending in ``advice``, unless exactly one vehicle of the named scenario learns.

    ``learners``: names of those that do.
    """
    if len(learners) != 1:
        raise InvalidInput(
            f"scenario {scenario!r} has {len(learners)} learners ({', '.join(learners) or 'none'}); {advice}"
        )
