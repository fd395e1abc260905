"""Progress reports of a long computation, as objects and as text on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a long computation: ``done`` of ``total`` units of work are done; ``name`` says what is computed.

    In training, a unit of work is one decision of a learner, and ``total`` is rounded up to a whole number of policy
    updates.

    >>> import ethbrake_marl as eb
    >>> eb.Progress("full_brake", 500, 1000)
    Progress(name='full_brake', done=500, total=1000, metrics={}, note='', updates=0, wall_s=0.0)
    """

    name: str  # "training", the name of an agent, "figures", ...
    done: int  # number of worlds, or of decisions by learners
    total: int  # value of ``done`` at the end
    metrics: Mapping[str, float] = field(default_factory=dict)  # in training: results of the last evaluation
    note: str = ""  # message to print once
    updates: int = 0  # in training: policy updates so far
    wall_s: float = 0.0  # in training: seconds so far
    objective: str = field(default="", repr=False)  # name of the quantity in ``metrics["objective"]``

    @property
    def harm(self) -> str:
        """Harm in the last evaluation as text, such as ``total harm 24.19``; empty if there was no evaluation yet."""
        if self.objective and "objective" in self.metrics:
            return f"{self.objective} {self.metrics['objective']:.2f}"
        words = {"first_impact_harm": "first-impact harm", "total_harm": "total harm"}
        parts = [f"{words[key]} {value:.2f}" for key, value in self.metrics.items() if key in words]
        return ", ".join(parts[:1])

    @staticmethod
    def listener(told: Told) -> OnProgress | None:
        """Return the function to call with each ``Progress``, or None if progress is not reported.

        ``told`` is this function, ``"show"`` to print progress on stderr, or None. Without stderr nothing is printed.
        """
        if told == "show":
            return None if sys.stderr is None else ShownProgress()
        return told


OnProgress = Callable[[Progress], None]

Told = OnProgress | Literal["show"] | None
"""Receiver of progress reports: a function, ``"show"`` for text on stderr, or None for no reports."""


class ShownProgress:
    """Prints progress on stderr.

    On a terminal, one line of text is updated in place. Otherwise, a new line is printed for each tenth of the work and
    for each evaluation.
    """

    def __init__(self) -> None:
        self._terminal = False
        with suppress(AttributeError, ValueError):  # no terminal either: a stream that is closed or has no ``isatty``
            self._terminal = sys.stderr.isatty()
        self._last: tuple[str, int] | None = None  # harm and tenth of the last line

    def __call__(self, progress: Progress) -> None:
        """Print the progress if it changed."""
        ended, harm = progress.done >= progress.total, progress.harm
        news = (harm, 10 * progress.done // max(progress.total, 1))
        if not (self._terminal or progress.note or news != self._last):
            return
        self._last = news
        text = f"{progress.name}: {progress.done:,} of {progress.total:,}"
        text += f", {harm}" if harm else ""
        text += f"; {progress.note}" if progress.note else ""
        line = f"\r{text}\x1b[K{chr(10) if ended else ''}" if self._terminal else f"{text}\n"
        with suppress(AttributeError, OSError, ValueError):  # nobody listens to a stream that is closed or cannot flush
            print(line, end="", file=sys.stderr, flush=True)  # noqa: T201
