"""The frame of every command: groups, shared options, help, where a wrong name leads, and its output."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from difflib import get_close_matches
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, NoReturn, TextIO, TypeVar, get_origin, get_type_hints

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from typer.core import TyperArgument, TyperCommand, TyperGroup

from ethbrake_marl import __version__
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.envs import register_environments
from ethbrake_marl.errors import InvalidInput, Progress as PartProgress, check_whole_number, need, one_line, plain_text

_KEPT = "\n\t\N{NO-BREAK SPACE}"  # in lines of a result; the last stands between a number and its unit
EVERY_S = 10.0  # between two signs of life where stderr is no terminal


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
        self._said_s = -EVERY_S  # when a line was said last, where stderr is no terminal
        self._begun: dict[str, tuple[float, int]] = {}  # when each part was first heard of, and how far it was

    def result(self, content: Any, *shown: RenderableType, end: str = "\n") -> None:
        """The result: ``content`` as JSON where that is asked for, else what is ``shown``."""
        if self.as_json:
            self.print_json(content)
        else:
            self.show(*shown, end=end)

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
        from ethbrake_marl.files.store import check_target

        check_target(path, force=self.force)

    def write(self, path: Path, content: bytes | str, what: str | None = None) -> None:
        """Write a file in one step, and say ``what`` it is."""
        from ethbrake_marl.files.store import write_output

        write_output(path, content.encode() if isinstance(content, str) else content, force=self.force)
        if what is not None:
            self.note(f"{what}: {path}")

    def interrupted(self, told: str) -> NoReturn:
        """End the command as Ctrl-C does, with one line."""
        self.note(told)
        raise typer.Exit(130)  # 128 + SIGINT, as shells expect

    def progress(self, name: str, done: int, total: int, harm: str = "", note: str = "") -> None:
        """The part ``name`` has come to ``done`` of ``total``; ``note`` is said once, above the bars.

        On a terminal one bar per part, else a line at the beginning and every ten seconds. What stands behind ": " in
        a name is a stage of the part before it, and shares its bar.
        """
        label = one_line(f"{name}, {harm}" if harm else name)
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
        part = name.partition(": ")[0]
        if part not in self._tasks:
            self._tasks[part] = self._bars.add_task(label, total=total)
        self._bars.update(self._tasks[part], completed=min(done, total), total=total, description=label)

    def _say_progress(self, name: str, label: str, done: int, total: int) -> None:
        now = time.monotonic()
        begun_s, first = self._begun.setdefault(name, (now, done))
        if now - self._said_s >= EVERY_S:
            left_s = (now - begun_s) * (total - done) / (done - first) if done > first else 0.0
            say(f"{label}: {done:,} of {total:,}{f', about {left_s:.0f} s left' if left_s >= 1.0 else ''}")
            self._said_s = now

    def show_progress(self, progress: PartProgress) -> None:
        """``progress`` of a ``Progress``, as the package tells it."""
        self.progress(progress.name, progress.done, progress.total, progress.harm, progress.note)

    def end_progress(self) -> None:
        """Leave the bars as they are; what comes next stands below them."""
        if self._bars is not None:
            self._bars.stop()
            self._bars, self._tasks = None, {}


class _PlainConsole(Console):
    """Shows text as it is: no markup in the names of agents and paths, and nothing that commands the terminal."""

    def __init__(self, file: TextIO, *, width: int | None = None) -> None:
        super().__init__(file=file, width=width, markup=False, emoji=False, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """The pieces of a line or table; those that rich made to style and move keep what they hold."""
        for piece in super().render(renderable, options):
            yield piece if piece.control else Segment(plain_text(piece.text, keep=_KEPT), piece.style)


# The frame of every command: groups, options that commands share, help, and where a wrong name leads.

Run = TypeVar("Run", bound=Callable[..., None])


def whole_number(least: int, most: int | None = None) -> Callable[[typer.CallbackParam, int | None], int | None]:
    """The callback of an option that is a whole number in this range."""

    def check(option: typer.CallbackParam, value: int | None) -> int | None:
        if value is not None:
            check_whole_number(str(option.name).replace("_", "-"), value, least, most)
        return value

    return check


OPTIONS: dict[str, Any] = {  # of parameters that bring no option of their own, by their name
    "scenario": typer.Option(metavar="NAME|PATH", help="A shipped or registered scenario, or a path to a YAML file."),
    "recipe": typer.Option(metavar="NAME|PATH", help="A shipped recipe, or a path to a YAML file."),
    "settings": typer.Option(
        "--set", metavar="KEY=VALUE", help="Another value of the scenario, or of the recipe: mass_t=40. Repeatable."
    ),
    "steps": typer.Option(help="Training steps (decisions), rounded up to whole updates.", show_default="the recipe's"),
    "agents": typer.Option(metavar="A,B,...", help="Who drives, with commas between them: `ethbrake agent list`."),
    "vehicle": typer.Option(help="Who is driven; other learners brake fully.", show_default="the learner"),
    "episodes": typer.Option(help="Worlds of the list."),
    "seed": typer.Option(help="Seed of the list."),
    "world": typer.Option(help="Number of the world in the list.", min=0),
    "harm_count": typer.Option(help="Harm that agents minimise: first impacts only, or all."),
    "uncertainty": typer.Option(
        metavar="QUANTITY=WIDTH,...",
        help=f"What the robust shield does not know, such as {DEFAULT.UNCERTAINTY_EXAMPLE}.",
    ),
    "jobs": typer.Option(help="So many at once, a process each; changes no result.", callback=whole_number(1, 64)),
    "ray": typer.Option(metavar="local|ADDRESS", help="Do the work on Ray, not in processes of our own."),
    "force": typer.Option("--force", help="Replace what is already there."),
    "as_json": typer.Option("--json", help="Print the figures as JSON, and nothing else, on stdout."),
}

ORDER = (
    *("run", "train", "evaluate", "compare", "shield", "reproduce", "agent", "scenario", "recipe", "search", "study"),
    *("watch", "doctor"),
)
DEFAULTS = {"train": "start", "doctor": "check"}  # of a group where no command is named
MOVED = {  # commands of earlier versions
    "resume": "train resume",
    "learning-curves": "train curves",
    "agents": "agent list",
    "export": "agent export",
    "best-harm": "search best-harm",
    "falsify": "search falsify",
    "sweep": "study sweep",
    "tune": "study tune",
    "ablate": "study ablate",
    "record": "watch record",
    "picture": "watch picture",
    "dataset": "watch dataset",
    "bench": "doctor speed",
}
PARTS = [  # as ``part_names`` tells them: to ask for them takes the engine, and this a hundredth of that
    ("Reward terms", "harm, collision, risk, jerk, terminal, shaping"),
    (
        "Observation",
        "own, front_K, rear_K, role, obstacle, front_K.age, rear_K.age, front_K.build_up_time, rear_K.build_up_time,"
        " front_K.release_time, rear_K.release_time, own_build_up_time, own_release_time, place",
    ),
    ("V2X presets", "paper, clear, nominal, congested, blocked, sensors-only"),
    ("Objectives", "total, own, social:ANGLE, maximin, mass-weighted, weighted:W1,W2,..., injury:CURVE"),
    ("Algorithms", "ppo, sac, counterfactual, options"),
    ("Measures", "injury"),
]


def _option(parameter: Parameter, hint: Any) -> Parameter:
    """A parameter as Typer reads it, with the shared option of its name where it brings none."""
    if get_origin(hint) is not Annotated and hint is not typer.Context:
        hint = Annotated[hint, OPTIONS[parameter.name]]
    return parameter.replace(annotation=hint, kind=Parameter.KEYWORD_ONLY)


class CommandWithParts(TyperCommand):
    """A command whose help ends with the names that recipes and scenarios may have."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """The epilog, and the names behind it; nothing can be registered where the physics is not even imported."""
        super().format_epilog(ctx, formatter)
        with formatter.section("What recipes and scenarios may name"):
            formatter.write_dl(part_names() if "ethbrake_marl.physics" in sys.modules else PARTS)


def part_names() -> list[tuple[str, str]]:
    """Kinds of parts, each with its names; what is registered is among them."""
    from ethbrake_marl.evaluation import MEASURES
    from ethbrake_marl.harm import OBJECTIVES
    from ethbrake_marl.learning import algorithm_names
    from ethbrake_marl.observations import FEATURES
    from ethbrake_marl.rewards import TERMS
    from ethbrake_marl.scenario import CHANNELS

    features = FEATURES.usable().items()
    own = [name if entry.of == "own" else f"front_K.{name}, rear_K.{name}" for name, entry in features]
    return [
        ("Reward terms", ", ".join(TERMS)),
        ("Observation", ", ".join(["own", "front_K", "rear_K", "role", "obstacle", *own])),
        ("V2X presets", ", ".join(CHANNELS)),
        ("Objectives", ", ".join(kind.form for kind in OBJECTIVES.usable().values())),
        ("Algorithms", ", ".join(algorithm_names())),
        ("Measures", ", ".join(MEASURES)),
    ]


class Group(TyperGroup):
    """Commands, of which one may be meant where none is named; a wrong name is told where it leads."""

    @property
    def default(self) -> Any:
        """The command that is meant where none is named."""
        return self.commands.get(DEFAULTS.get(self.name or "", ""))

    def list_commands(self, ctx: Any) -> list[str]:
        """Their names, those of ``ethbrake`` by use; users' own are last."""
        first = [] if ctx.parent is not None else [name for name in ORDER if name in self.commands]
        return [*first, *(name for name in self.commands if name not in first)]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the default's name where no command is named; who asks for completion or help may want any."""
        default, word = self.default, args[0] if args else ""
        named = word in (*self.commands, "-h", "--help") or (not word and ctx.resilient_parsing)
        if default is not None and not named:
            takes_words = any(isinstance(each, TyperArgument) for each in default.params)
            if not word or word.startswith("-") or takes_words:
                args = [default.name, *args]
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """The commands, and the options of the default."""
        if self.default is None:
            super().format_options(ctx, formatter)
            return
        self.format_commands(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text(f"Without a command it is {self.default.name}:")
        self.default.format_options(ctx, formatter)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """The examples, and what the help of the default ends with."""
        super().format_epilog(ctx, formatter)
        if isinstance(self.default, CommandWithParts):
            CommandWithParts(None).format_epilog(ctx, formatter)

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """What can follow: commands, and the options of the default."""
        found = super().shell_complete(ctx, incomplete)
        more = [] if self.default is None else self.default.shell_complete(ctx, incomplete)
        return found + [each for each in more if each.value not in {one.value for one in found}]

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """The command that is named."""
        if args[0] not in self.commands and not args[0].startswith("-") and not ctx.resilient_parsing:
            self._tell_where(ctx, args[0])
        return super().resolve_command(ctx, args)

    def _tell_where(self, ctx: Any, name: str) -> None:
        """Fail, and say the place of a command that has moved, or of the nearest ones."""
        root = ctx.find_root().command
        if self is root and name in MOVED:
            ctx.fail(f"{name} is now: {MOVED[name]}")
        here = {each: f"{ctx.command_path} {each}" for each in self.commands}
        places = {**{old: f"ethbrake {new}" for old, new in MOVED.items()}, **_places(root, "ethbrake"), **here}
        close = get_close_matches(name, here, n=1) or get_close_matches(name, places, n=1)
        hint = f"did you mean: {places[close[0]]}?" if close else f"known: {', '.join(self.commands)}"
        ctx.fail(f"unknown command {name!r}; {hint}")


def _places(group: Any, path: str) -> Mapping[str, str]:
    """The whole of each command in a group, by its last word."""
    found = {name: f"{path} {name}" for name in group.commands}
    for name, each in group.commands.items():
        if isinstance(each, TyperGroup):
            found = {**_places(each, f"{path} {name}"), **found}
    return found


class Commands(typer.Typer):
    """A group of commands: those of ``ethbrake`` itself, or of one group inside another."""

    def group(self, name: str, about: str, *examples: str) -> Commands:
        """A new group inside this one; its help page shows the examples."""
        shown = "\n\n".join(f"Example: ethbrake {example}" for example in examples)
        group = Commands(cls=Group, rich_markup_mode=None, help=about, epilog=shown)
        self.add_typer(group, name=name)
        return group

    def add(
        self,
        name: str,
        example: str,
        *,
        kept: str = "nothing was written",
        needs: tuple[str, ...] = (),
        json: bool = False,
        force: bool = False,
        parts: bool = False,
    ) -> Callable[[Run], Run]:
        """Make a function a command of this group; its first argument is the command's ``Out``.

        Args:
            name: of the command.
            example: of its use, behind ``ethbrake``.
            kept: what Ctrl-C leaves, in words.
            needs: packages of extras, without which it ends before any work.
            json: it has the option --json; its ``Out`` knows whether that was given.
            force: the same of --force.
            parts: its help ends with what recipes and scenarios may name.

        """

        def register(run: Run) -> Run:
            hints = get_type_hints(run, include_extras=True)
            given = [_option(each, hints[each.name]) for each in list(signature(run).parameters.values())[1:]]
            flags = [flag for flag, wanted in (("force", force), ("as_json", json)) if wanted]
            given += [_option(Parameter(each, Parameter.KEYWORD_ONLY, default=False), bool) for each in flags]

            @wraps(run)
            def call(**options: Any) -> None:
                out = Out(**{flag: options.pop(flag) for flag in flags}, kept=kept)
                with redirect_stdout(sys.stderr):
                    for package in needs:
                        need(package)
                    register_environments()
                    try:
                        run(out, **options)
                    except KeyboardInterrupt:
                        out.interrupted(f"interrupted; {out.kept}")
                    finally:
                        out.end_progress()

            call.__signature__ = Signature(given)  # type: ignore[attr-defined]  # what Typer reads
            call.__annotations__ = {each.name: each.annotation for each in given}
            cls = CommandWithParts if parts else TyperCommand
            self.command(name, cls=cls, epilog=f"Example: ethbrake {example}")(call)
            return run

        return register


app = Commands(
    cls=Group,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Ethical emergency braking: train, shield, evaluate. Every command has its own --help with an example.",
    epilog="Example: ethbrake run\n\nExample: ethbrake watch record --agents full_brake,e_v2x_bm --output both.gif",
)


def _show_version(asked: bool) -> None:
    if asked:
        Out().show(f"ethbrake {__version__}")
        raise typer.Exit


@app.callback()
def _about(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options of ``ethbrake`` itself."""
