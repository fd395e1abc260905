"""Progress reports of a long computation, as objects and as text on stderr."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

from ethbrake_marl.errors import one_line

LEAST_SHARE = 0.03  # share of the work that must be done before the time left is estimated
EVERY_S = 10.0  # time between two lines of progress (s) if stderr is not a terminal


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a long computation: ``done`` of ``total`` units of work, for the task ``name``.

    In training, a unit is one decision of a learner, and ``total`` is rounded up to whole updates.

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
        """Such as ``total harm 24.19``; empty before the first evaluation."""
        if self.objective and "objective" in self.metrics:
            return f"{self.objective} {self.metrics['objective']:.2f}"
        count = next((key for key in self.metrics if key.endswith(("_harm", "_cost"))), "")  # the one that is minimised
        words = count.replace("_", " ").replace("first impact", "first-impact")
        return f"{words} {self.metrics[count]:.2f}" if count else ""

    @property
    def measured(self) -> str:
        step = self.metrics.get("steps", self.done)
        return f"{self.harm} at step {step:,.0f}" if self.harm and step != self.done else self.harm

    @staticmethod
    def listener(on_progress: ProgressOption) -> OnProgress | None:
        """``on_progress``: None: no reports; ``"show"``: on stderr (if the process has one)."""
        if on_progress == "show":
            return None if sys.stderr is None else ShownProgress()
        return on_progress


OnProgress = Callable[[Progress], None]

ProgressOption = OnProgress | Literal["show"] | None
"""Receiver of progress reports: a function, ``"show"`` for text on stderr, or None for no reports."""


class ShownProgress:
    """Prints progress on stderr: on a terminal one line that is updated, otherwise a new line every ten seconds."""

    def __init__(self) -> None:
        self._terminal = False
        with suppress(AttributeError, ValueError):  # no terminal either: a stream that is closed or has no ``isatty``
            self._terminal = sys.stderr.isatty()
        self._begun: dict[str, tuple[float, int]] = {}  # name -> time and ``done`` of its first report
        self._told_s = -EVERY_S  # time of the last line that was printed without a terminal
        self._open = ""  # name of the task in the terminal's last line; empty if this line has ended

    def __call__(self, progress: Progress) -> None:
        now, task = time.monotonic(), progress.name.partition(": ")[0]
        if self._open not in ("", task) or progress.note:
            self.end()
        if progress.note:
            self._print(f"{one_line(progress.note)}\n")
        begun_s, first = self._begun.setdefault(progress.name, (now, progress.done))
        text = f"{progress.name}: {progress.done:,} of {progress.total:,}"
        text += f", {progress.measured}" if progress.harm else ""
        if progress.done > first + LEAST_SHARE * progress.total:
            left_s = (now - begun_s) * (progress.total - progress.done) / (progress.done - first)
            text += f", about {left_s:.0f} s left" if left_s >= 1.0 else ""
        if self._terminal:
            tenths = min(10 * progress.done // max(progress.total, 1), 10)
            width = shutil.get_terminal_size().columns
            line = f"[{'#' * tenths:10}] {one_line(text)}"
            self._print(f"\r{line[: width - 1]}\x1b[K")
            self._open = task
            if progress.done >= progress.total:
                self.end()
        elif now - self._told_s >= EVERY_S:
            self._print(f"{one_line(text)}\n")
            self._told_s = now

    def end(self) -> None:
        if self._open:
            self._print("\n")
            self._open = ""

    def _print(self, text: str) -> None:
        with suppress(AttributeError, OSError, ValueError):  # nobody listens to a stream that is closed or cannot flush
            print(text, end="", file=sys.stderr, flush=True)  # noqa: T201
