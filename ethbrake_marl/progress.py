"""Progress of a long piece of work, for whoever asks to see it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class Progress:
    """``done`` of ``total`` of the part called ``name``.

    Of a training ``done`` counts decisions of learners, and ``total`` is what they come to in whole updates.

    >>> import ethbrake_marl as eb
    >>> eb.Progress("full_brake", 500, 1000)
    Progress(name='full_brake', done=500, total=1000, metrics={}, note='', updates=0, wall_s=0.0)

    """

    name: str  # "training", an agent that drives, "figures", ...
    done: int  # worlds, or decisions of learners
    total: int  # the same when it is done
    metrics: Mapping[str, float] = field(default_factory=dict)  # of a policy while it is trained: its last evaluation
    note: str = ""  # to be told once
    updates: int = 0  # of a training
    wall_s: float = 0.0  # of a training
    objective: str = field(default="", repr=False)  # what ``metrics["objective"]`` is, in words

    @property
    def harm(self) -> str:
        """The harm that a training is for, in words: that of ``metrics`` which stands first; empty without one."""
        if self.objective and "objective" in self.metrics:
            return f"{self.objective} {self.metrics['objective']:.2f}"
        words = {"first_impact_harm": "first-impact harm", "total_harm": "total harm"}
        told = [f"{words[key]} {value:.2f}" for key, value in self.metrics.items() if key in words]
        return ", ".join(told[:1])

    @staticmethod
    def listener(told: Told) -> OnProgress | None:
        """The function to tell; for ``show`` one that writes on stderr."""
        return ShownProgress() if told == "show" else told


OnProgress = Callable[[Progress], None]

Told = OnProgress | Literal["show"] | None
"""Who is told how far a training is: a function, stderr (``show``), or nobody."""


class ShownProgress:
    """Shows on stderr how far a training is: on a terminal in one line, else one for each tenth and evaluation."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last: tuple[str, int] | None = None  # harm and tenth of the last line

    def __call__(self, progress: Progress) -> None:
        """Show it, if it is news."""
        ended, harm = progress.done >= progress.total, progress.harm
        news = (harm, 10 * progress.done // max(progress.total, 1))
        if not (self._terminal or progress.note or news != self._last):
            return
        self._last = news
        text = f"{progress.name}: {progress.done:,} of {progress.total:,}"
        text += f", {harm}" if harm else ""
        text += f"; {progress.note}" if progress.note else ""
        sys.stderr.write(f"\r{text}\x1b[K{chr(10) if ended else ''}" if self._terminal else f"{text}\n")
        sys.stderr.flush()
