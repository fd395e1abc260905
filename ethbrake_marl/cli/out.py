"""The output of commands: results on stdout; lines, progress and warnings on stderr; the files that are asked for."""

from __future__ import annotations

import io
import json
import os
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn, TextIO

import typer
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table

from ethbrake_marl.errors import IncompleteTable, InvalidInput, WithoutEffect, one_line, plain_text
from ethbrake_marl.errors import Progress as PartProgress
from ethbrake_marl.kernel_store import is_temporary, on_first_compilation

_KEPT = "\n\t\N{NO-BREAK SPACE}"  # in lines of a result; the last stands between a number and its unit
EVERY_S = 10.0  # between two signs of life where stderr is no terminal
INTERRUPTED = 130  # 128 + SIGINT, as shells expect
PAGES = (".html", ".htm")


def say(text: str) -> None:
    """One line to the person at the terminal, on stderr."""
    typer.echo(one_line(text), err=True)


class Out:
    """The output of one command.

    ``as_json``: results are wanted as JSON. ``force``: files are replaced. ``kept``: what Ctrl-C leaves, in words.
    Made before stdout is turned to stderr, for what a user's agent prints: results alone go to the stdout of then.
    """

    def __init__(self, *, as_json: bool = False, force: bool = False, kept: str = "nothing was written") -> None:
        self.as_json, self.force, self.kept = as_json, force, kept
        self._stdout = sys.stdout
        self._stderr: Console = _PlainConsole(sys.stderr)
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._last_label, self._last_done, self._said_s = "", False, 0.0
        self._begun: dict[str, tuple[float, int]] = {}  # when each part was first heard of, and how far it was

    def result(self, content: Any, *shown: RenderableType) -> None:
        """The result: ``content`` as JSON where that is asked for, else what is ``shown``."""
        if self.as_json:
            self.print_json(content)
        else:
            self.show(*shown)

    def print_json(self, content: Any) -> None:
        """JSON on stdout, asked for or not."""
        self.end_progress()
        typer.echo(json.dumps(content, indent=2, allow_nan=False), self._stdout)

    def show(self, *shown: RenderableType, end: str = "\n") -> None:
        """Texts and tables of a result; nothing in a text but line ends and tabs moves the cursor."""
        self.end_progress()
        for each in shown:
            if isinstance(each, str):
                typer.echo(plain_text(each, keep=_KEPT) + end, self._stdout, nl=False)
            else:  # at the terminal's width, or 100 columns in a file
                _PlainConsole(self._stdout, width=None if self._stdout.isatty() else 100).print(each)

    def note(self, text: str) -> None:
        """One line to the person at the terminal, below the progress."""
        self.end_progress()
        say(text)

    def check(self, path: Path | None, *endings: str, what: str = "the file") -> None:
        """Refuse, before any work, a file that cannot be written; None: none is wanted."""
        if path is None:
            return
        if endings and path.suffix.lower() not in endings:
            raise InvalidInput(f"{path}: {what} must end in {' or '.join(endings)}")
        from ethbrake_marl.evaluation.results import check_target

        check_target(path, force=self.force)

    def write(self, path: Path, content: bytes | str, what: str | None = None) -> None:
        """Write a file in one step, and say ``what`` it is."""
        from ethbrake_marl.evaluation.results import write_output

        write_output(path, content.encode() if isinstance(content, str) else content, force=self.force)
        if what is not None:
            self.note(f"{what}: {path}")

    def interrupted(self, told: str) -> NoReturn:
        """End the command as Ctrl-C does, with one line."""
        self.note(told)
        raise typer.Exit(INTERRUPTED)

    def progress(
        self,
        name: str,
        done: int,
        total: int,
        metrics: Mapping[str, float] | None = None,
        note: str = "",
        label: str | None = None,
    ) -> None:
        """The part ``name`` has come to ``done`` of ``total``; ``note`` is said once, above the bars.

        On a terminal one bar per part, else a line: news, and every ten seconds. ``label`` is what stands before the
        figures, by default the name and the harm.
        """
        harm = (metrics or {}).get("first_impact_harm")
        label = one_line(label or (name if harm is None else f"{name}, first-impact harm {harm:.2f}"))
        if not self._stderr.is_terminal:
            if note:
                say(note)
            self._say_progress(name, label, done, total)
            return
        if note:
            self._stderr.print(one_line(note), highlight=False)
        if self._bars is None:
            text = TextColumn("{task.description}", markup=False)
            self._bars = Progress(text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=self._stderr)
            self._bars.start()
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(label, total=total)
        self._bars.update(self._tasks[name], completed=min(done, total), total=total, description=label)

    def _say_progress(self, name: str, label: str, done: int, total: int) -> None:
        now = time.monotonic()
        news = label != self._last_label or (done >= total and not self._last_done)
        begun_s, first = self._begun.setdefault(name, (now, done))
        if news or now - self._said_s >= EVERY_S:
            left_s = (now - begun_s) * (total - done) / (done - first) if done > first else 0.0
            say(f"{label}: {done:,} of {total:,}{f', about {left_s:.0f} s left' if left_s >= 1.0 else ''}")
            self._said_s = now
        self._last_label, self._last_done = label, done >= total

    def show_progress(self, progress: PartProgress) -> None:
        """``progress`` of a ``Progress``, as the package tells it."""
        self.progress(progress.name, progress.done, progress.total, progress.metrics, progress.note)

    def end_progress(self) -> None:
        """Leave the bars as they are; what comes next stands below them."""
        if self._bars is not None:
            self._bars.stop()
            self._bars, self._tasks = None, {}


def plain_table(*columns: str, **settings: Any) -> Table:
    """An empty table with a line below its heading; long cells are folded."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title_justify="left", **settings)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


class _PlainConsole(Console):
    """Shows text as it is: no markup in the names of agents and paths, and nothing that commands the terminal."""

    def __init__(self, file: TextIO, *, width: int | None = None) -> None:
        super().__init__(file=file, width=width, markup=False, emoji=False, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """The pieces of a line or table; those that rich made to style and move keep what they hold."""
        for piece in super().render(renderable, options):
            yield piece if piece.control else Segment(plain_text(piece.text, keep=_KEPT), piece.style)


def prepare_streams() -> None:
    """Show ``?`` for what stdout's encoding does not have (m², box lines in Latin-1) instead of failing at the end.

    The package's own warnings are one line each, and one says why the first command takes longer.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    shown = warnings.showwarning

    def show_warning(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, IncompleteTable | WithoutEffect):
            say(f"warning: {message}")
        else:
            shown(message, category, *place, **more)

    warnings.showwarning = show_warning
    on_first_compilation(tell_compilation)


def tell_compilation(folder: Path, empty: bool) -> None:
    """Say what is compiled, when it begins, and every ten seconds how many kernels are, as long as that takes."""
    if is_temporary(folder):
        say("compiling the physics; no folder can be written to keep it, so every command does (ethbrake doctor)")
    elif empty:
        say("compiling the physics, once: minutes of one core, then it is kept")
    else:
        say("compiling what was not used before, once, then it is kept")
    from numba.core import event  # loaded by whatever compiles, and by nothing that does not

    events: Any = event  # numba's own types end here
    begun, said, count = time.monotonic(), time.monotonic(), 0

    class Count(event.Listener):  # type: ignore[misc]  # numba has no types
        def on_start(self, event_: event.Event) -> None:
            """Nothing: it counts what is done."""

        def on_end(self, event_: event.Event) -> None:
            nonlocal said, count
            count, now = count + 1, time.monotonic()
            if now - said >= EVERY_S:
                said = now
                say(f"compiling: {count} kernels in {now - begun:.0f} s so far")

    events.register("numba:compile", Count())


def abandon_output() -> None:
    """Drop what stdout still holds and cannot hand on (a full disk), or Python fails a second time when it ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
