"""Output of the command line: lines and progress bars on stderr, results and JSON on stdout."""

from __future__ import annotations

import io
import json
import os
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.segment import Segment

from ethbrake_marl.errors import IncompleteTable, WithoutEffect, one_line, plain_text
from ethbrake_marl.errors import Progress as PartProgress
from ethbrake_marl.kernel_store import is_temporary, on_first_compilation

_KEPT = "\n\t\N{NO-BREAK SPACE}"  # in lines of a result; the last stands between a number and its unit
EVERY_S = 10.0  # between two signs of life where stderr is no terminal
INTERRUPTED = 130  # 128 + SIGINT, as shells expect


def say(text: str) -> None:
    """One line to the person at the terminal, on stderr."""
    typer.echo(one_line(text), err=True)


def show(text: str, end: str = "\n") -> None:
    """Lines of a result, on stdout; nothing in them but line ends and tabs moves the cursor."""
    typer.echo(plain_text(text, keep=_KEPT) + end, _stdout(), nl=False)


def write_json(content: Any) -> None:
    """JSON on stdout."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False), _stdout())


_KEPT_STDOUT: list[TextIO] = []  # while what others print goes to stderr


def _stdout() -> TextIO:
    return _KEPT_STDOUT[-1] if _KEPT_STDOUT else sys.stdout


@contextmanager
def results_alone() -> Iterator[None]:
    """Keep stdout for results while the block runs: what a user's agent or plug-in prints goes to stderr."""
    _KEPT_STDOUT.append(_stdout())
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _KEPT_STDOUT.pop()


def tolerate_narrow_streams() -> None:
    """Show ``?`` for what stdout's encoding does not have (m², box lines in Latin-1) instead of failing at the end."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def tell_warnings() -> None:
    """Show the package's own warnings in one line, without the place in its code."""
    shown = warnings.showwarning

    def show_warning(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, IncompleteTable | WithoutEffect):
            say(f"warning: {message}")
        else:
            shown(message, category, *place, **more)

    warnings.showwarning = show_warning


def tell_compilation() -> None:
    """Say in one line why the first command takes longer, when it begins to compile."""

    def tell(folder: Path, empty: bool) -> None:
        if is_temporary(folder):
            say("compiling the physics; no folder can be written to keep it, so every command does (ethbrake doctor)")
        elif empty:
            say("compiling the physics, once: minutes of one core, then it is kept")
        else:
            say("compiling what was not used before, once, then it is kept")
        _count_kernels()

    on_first_compilation(tell)


def _count_kernels() -> None:
    """Say every ten seconds how many kernels this process has compiled, as long as it does."""
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


def shell_asks(environment: Mapping[str, str]) -> bool:
    """Whether a shell's completion runs this command, as its script from ``--show-completion`` does.

    The variable alone, or with what no such script sets, is ignored: a command must not fail because of it.
    """
    if environment.get("_ETHBRAKE_COMPLETE") == "complete_bash":
        return "COMP_WORDS" in environment and environment.get("COMP_CWORD", "").isdecimal()
    others = ("complete_zsh", "complete_fish", "complete_powershell", "complete_pwsh")
    return environment.get("_ETHBRAKE_COMPLETE") in others and "_TYPER_COMPLETE_ARGS" in environment


def abandon_output() -> None:
    """Drop what stdout still holds and cannot hand on (a full disk), or Python fails a second time when it ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def interruptible(kept: str) -> Iterator[None]:
    """Turn Ctrl-C inside the block into one line, which says what is kept, and the exit status of an interruption."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted; {kept}")
        raise typer.Exit(INTERRUPTED) from None


class Bars:
    """One progress bar per part of the work when stderr is a terminal, else a line: news, and every ten seconds."""

    def __init__(self, bars: Progress | None) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}
        self._last_label, self._last_done, self._said_s = "", False, 0.0
        self._begun: dict[str, tuple[float, int]] = {}  # when each part was first heard of, and how far it was

    def show(
        self,
        name: str,
        done: int,
        total: int,
        metrics: Mapping[str, float] | None = None,
        note: str = "",
        label: str | None = None,
    ) -> None:
        """The part ``name`` has come to ``done`` of ``total``; ``note`` is said once, above the bars.

        ``label`` is what stands before the figures, by default the name and the harm.
        """
        harm = (metrics or {}).get("first_impact_harm")
        label = one_line(label or (name if harm is None else f"{name}, first-impact harm {harm:.2f}"))
        if note:
            self.tell(note)
        if self._bars is None:
            now = time.monotonic()
            news = label != self._last_label or (done >= total and not self._last_done)
            begun_s, first = self._begun.setdefault(name, (now, done))
            if news or now - self._said_s >= EVERY_S:
                left_s = (now - begun_s) * (total - done) / (done - first) if done > first else 0.0
                say(f"{label}: {done:,} of {total:,}{f', about {left_s:.0f} s left' if left_s >= 1.0 else ''}")
                self._said_s = now
            self._last_label, self._last_done = label, done >= total
            return
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(label, total=total)
        self._bars.update(self._tasks[name], completed=min(done, total), total=total, description=label)

    def show_progress(self, progress: PartProgress) -> None:
        """The same of a ``Progress``."""
        self.show(progress.name, progress.done, progress.total, progress.metrics, progress.note)

    def tell(self, text: str) -> None:
        """One line above the bars."""
        if self._bars is None:
            say(text)
        else:
            self._bars.console.print(one_line(text), highlight=False)


@contextmanager
def progress_bars() -> Iterator[Bars]:
    """Bars on stderr while the block runs."""
    console = _PlainConsole(sys.stderr)
    if not console.is_terminal:
        yield Bars(None)
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bars:
        yield Bars(bars)


class _PlainConsole(Console):
    """Shows text as it is: no markup in the names of agents and paths, and nothing that commands the terminal."""

    def __init__(self, file: TextIO, *, width: int | None = None) -> None:
        super().__init__(file=file, width=width, markup=False, emoji=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """The pieces of a line or table; those that rich made to style and move keep what they hold."""
        for piece in super().render(renderable, options):
            yield piece if piece.control else Segment(plain_text(piece.text, keep=_KEPT), piece.style)


def result_console() -> Console:
    """Where tables go: stdout, at the terminal's width or 100 columns in a file."""
    return _PlainConsole(_stdout(), width=None if _stdout().isatty() else 100)
