"""One job as every place runs it: a function and what it is given, as bytes, and what came of it."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ethbrake_marl.errors import EthBrakeError, describe_error
from ethbrake_marl.files.plugins import Plugin, load_the_same

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # of a worker


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of one attempt at a job."""

    value: Any = None  # None: it was stopped before its end, and can go on
    error: BaseException | None = None
    again: bool = False  # whether another attempt may end better
    wall_s: float = 0.0
    where: str = ""  # the process that did it


class Workers(Protocol):
    """Where jobs run, several at a time."""

    def room(self) -> int:
        """How many more jobs can be begun now."""

    def begin(self, number: int, call: bytes) -> None:
        """Begin a job, which is known by its number from then on."""

    def wait(self) -> list[tuple[int, Answer]]:
        """The jobs that have ended since; waits for one, but no longer than about a second."""

    def interrupt(self) -> None:
        """Ask every running job to end soon and to keep what it has; none waits for its turn any more."""

    def close(self) -> None:
        """End all workers, whatever they do."""


def pack(function: Callable[..., Any], *given: Any) -> bytes:
    """A call as bytes; the function stands in a module."""
    return pickle.dumps((function, given))


def answer(call: bytes, plugins: Sequence[Plugin], where: str) -> Answer:
    """Do a job in a worker, after loading the plug-ins of the process that asks for it.

    An error of this package would come again; any other one may be of the machine.
    """
    started = time.monotonic()
    try:
        load_the_same(plugins)
        function, given = pickle.loads(call)
        value = function(*given)
    except (Exception, SystemExit) as error:
        lasting = isinstance(error, EthBrakeError)
        return Answer(None, _sendable(error), not lasting, time.monotonic() - started, where)
    return Answer(value, None, value is None, time.monotonic() - started, where)


def process_name() -> str:
    """Computer and number of this process, for a log."""
    return f"{os.uname().nodename}, process {os.getpid()}"


def _sendable(error: BaseException) -> BaseException:
    """The error, or its text where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(describe_error(error))
    return error
