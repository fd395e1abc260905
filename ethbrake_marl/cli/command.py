"""Options that several commands share, and ``Out``, the output of a command."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, NoReturn, Self, TextIO

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from ethbrake_marl.errors import EthBrakeError, InvalidInput, one_line, plain_text
from ethbrake_marl.faces.registration import register_environments
from ethbrake_marl.program import INTERRUPTED
from ethbrake_marl.progress import Progress, ShownProgress

# special characters allowed in results; the no-break space is used between a number and its unit
_UNESCAPED = "\n\t\N{NO-BREAK SPACE}"

UNWRITTEN = 3  # exit status if output cannot be written

ScenarioOption = Annotated[
    str, typer.Option(metavar="NAME|PATH", help="Name of a shipped or registered scenario, or path of a YAML file.")
]

SettingsOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, such as mass_t=40. Can be given several times."),
]

StepsOption = Annotated[
    int | None,
    typer.Option(
        help="Number of training steps (decisions), rounded up to whole updates.", show_default="as in the recipe"
    ),
]

AgentsOption = Annotated[
    str, typer.Option(metavar="A,B,...", help="Agents, separated by commas; `ethbrake agent list` shows all agents.")
]

SeedOption = Annotated[int, typer.Option(help="Seed of the evaluation list.")]

JobsOption = Annotated[
    int | None, typer.Option(help="Number of parallel processes; does not change results.", min=1, max=64)
]

ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing files.")]

JsonOption = Annotated[bool, typer.Option("--json", help="Print the results on stdout as JSON.")]


def example(*lines: str) -> str:
    """``lines``: commands without the word ``ethbrake``."""
    return "\n\n".join(f"Example: ethbrake {line}" for line in lines)


class Out:
    """In ``with Out() as out:`` only results go to stdout; everything else, such as what a user's agent prints, goes to
    stderr. Ctrl-C ends the command with exit status 130 and a message. ``remains``: end of this message, about files
    left behind.
    """

    def __init__(self, *, as_json: bool = False, force: bool = False, remains: str = "nothing was written") -> None:
        self.as_json, self.force, self.remains = as_json, force, remains
        self._stdout = sys.stdout
        self.show_progress = ShownProgress()  # receives the progress that a function of the package reports
        self._turned = redirect_stdout(sys.stderr)
        self.unwritten: list[OSError | EthBrakeError] = []

    def __enter__(self) -> Self:
        self._turned.__enter__()
        register_environments()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._turned.__exit__(kind, error, trace)
        self.show_progress.end()
        if isinstance(error, KeyboardInterrupt):
            self.interrupted(f"interrupted; {self.remains}")
        if isinstance(error, SystemExit):
            raise InvalidInput(f"your own code ended the process: SystemExit: {error.code}") from error
        if error is None and self.unwritten:
            raise typer.Exit(refuse(self.unwritten[0], UNWRITTEN))

    @contextmanager
    def writing(self) -> Iterator[None]:
        """An error waits until the command has printed the results."""
        try:
            yield
        except (OSError, EthBrakeError) as error:
            self.unwritten.append(error)

    def result(self, content: Any, *parts: RenderableType, in_file: bool = False) -> None:
        """``in_file``: whether a file also contains the result, so that nothing is lost if stdout is closed."""
        if in_file and not self._stdout.writable():
            return
        if self.as_json:
            self.print_json(content)
        else:
            self.show(*parts)

    def print_json(self, content: Any) -> None:
        self.show_progress.end()
        typer.echo(json.dumps(content, indent=2, allow_nan=False), self._stdout)

    def show(self, *parts: RenderableType, end: str = "\n") -> None:
        """Control characters in texts are escaped, except line ends and tabs."""
        self.show_progress.end()
        for part in parts:
            if isinstance(part, str):
                typer.echo(plain_text(part, keep=_UNESCAPED) + end, self._stdout, nl=False)
            else:  # at the terminal's width, or 100 columns in a file
                _PlainConsole(self._stdout, width=None if self._stdout.isatty() else 100).print(part)

    def note(self, text: str) -> None:
        self.show_progress.end()
        with suppress(OSError):  # nobody can be told
            typer.echo(one_line(text), err=True)

    def check(self, path: Path | None, *endings: str, what: str = "the file") -> None:
        """``path=None`` means no file.

        ``endings``: allowed file extensions, such as ``.csv``; none: all are allowed. ``what``: content of the file, in
        error messages. Raises ``InvalidInput``, or ``AlreadyExists`` without ``--force``.
        """
        if path is None:
            return
        if endings and path.suffix.lower() not in endings:
            raise InvalidInput(f"{path}: the name of a file with {what} must end in {' or '.join(endings)}")
        from ethbrake_marl.files.store import check_target

        check_target(path, force=self.force)

    def write(self, path: Path, content: bytes | str, what: str | None = None) -> None:
        """With ``what``, prints ``WHAT: PATH`` on stderr."""
        from ethbrake_marl.files.store import write_output

        write_output(path, content.encode() if isinstance(content, str) else content, force=self.force)
        if what is not None:
            self.note(f"{what}: {path}")

    def interrupted(self, text: str) -> NoReturn:
        self.note(text)
        raise typer.Exit(INTERRUPTED)

    def progress(self, name: str, count: int, total: int) -> None:
        self.show_progress(Progress(name, count, total))


def refuse(reason: Exception | str, status: int = 2) -> int:
    if isinstance(reason, OSError) and not isinstance(reason, EthBrakeError):
        reason = f"{reason.filename or 'output'!s:.200}: {reason.strerror or reason}"
    Out().note(f"ethbrake: error: {reason}")
    return status


class _PlainConsole(Console):
    """Prints texts literally, without markup, and escapes control characters.

    In a notebook, it also prints to ``file``. ``width``: in characters; None: the terminal's width.
    """

    def __init__(self, file: TextIO, *, width: int | None = None) -> None:
        super().__init__(file=file, width=width, markup=False, emoji=False, highlight=False, force_jupyter=False)

    def on_broken_pipe(self) -> NoReturn:
        """Rich itself would discard stderr, where stdout is redirected, and exit."""
        raise

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for piece in super().render(renderable, options):
            yield piece if piece.control else Segment(plain_text(piece.text, keep=_UNESCAPED), piece.style)
