"""The frame of every command: groups, options that commands share, help, plug-ins, and where a wrong name leads."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from difflib import get_close_matches
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, TypeVar, get_origin, get_type_hints

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup
from typer.main import get_command

from ethbrake_marl import __version__
from ethbrake_marl.cli.out import Out
from ethbrake_marl.defaults import UNCERTAINTY_EXAMPLE
from ethbrake_marl.envs.registration import register_environments
from ethbrake_marl.errors import AlreadyExists, check_whole_number, need
from ethbrake_marl.files.plugins import load_plugin

Run = TypeVar("Run", bound=Callable[..., None])

MOST_JOBS = 64


def _check_jobs(jobs: int) -> int:
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    return jobs


OPTIONS: dict[str, Any] = {  # of parameters that bring no option of their own, by their name
    "scenario": typer.Option(metavar="NAME|PATH", help="A shipped or registered scenario, or a path to a YAML file."),
    "recipe": typer.Option(metavar="NAME|PATH", help="A shipped recipe, or a path to a YAML file."),
    "settings": typer.Option(
        "--set", metavar="KEY=VALUE", help="Another value of the scenario, or of the recipe: mass_t=40. Repeatable."
    ),
    "steps": typer.Option(help="Training steps (decisions).", show_default="the recipe's"),
    "agents": typer.Option(metavar="A,B,...", help="Who drives, with commas between them: `ethbrake agent list`."),
    "vehicle": typer.Option(help="Who is driven; other learners brake fully.", show_default="the learner"),
    "episodes": typer.Option(help="Worlds of the list."),
    "seed": typer.Option(help="Seed of the list."),
    "world": typer.Option(help="Number of the world in the list.", min=0),
    "harm_count": typer.Option(help="Harm that agents minimise: first impacts only, or all."),
    "uncertainty": typer.Option(
        metavar="QUANTITY=WIDTH,...", help=f"What the robust shield does not know, such as {UNCERTAINTY_EXAMPLE}."
    ),
    "jobs": typer.Option(
        help=f"So many at once, up to {MOST_JOBS}, a process each; changes no result.", callback=_check_jobs
    ),
    "ray": typer.Option(metavar="local|ADDRESS", help="Do the work on Ray, not in processes of our own."),
    "force": typer.Option("--force", help="Replace what is already there."),
    "as_json": typer.Option("--json", help="Print the figures as JSON, and nothing else, on stdout."),
}

ORDER = (
    *("run", "train", "evaluate", "compare", "shield", "reproduce", "agent", "scenario", "recipe", "search", "study"),
    *("benchmark", "watch", "doctor"),
)
DEFAULTS = {"train": "start", "benchmark": "drive", "doctor": "check"}  # of a group where no command is named
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
    "generalise": "study generalise",
    "leaderboard": "benchmark table",
    "record": "watch record",
    "replay": "watch replay",
    "explore": "watch explore",
    "picture": "watch picture",
    "dataset": "watch dataset",
    "bench": "doctor speed",
}
PARTS = [  # as ``part_names`` tells them: to ask for them takes the engine, and this a hundredth of that
    ("Reward terms", "harm, collision, risk, jerk, terminal, shaping"),
    ("Observation", "own, front_K, rear_K, role, obstacle, front_K.age, rear_K.age"),
    ("V2X presets", "paper, clear, nominal, congested, blocked, sensors-only"),
    ("Objectives", "total, own, social:ANGLE, maximin, mass-weighted, weighted:W1,W2,..."),
    ("Algorithms", "ppo, sac, counterfactual"),
]


def command(
    group: typer.Typer,
    name: str,
    example: str,
    *,
    kept: str = "nothing was written",
    needs: tuple[str, ...] = (),
    json: bool = False,
    force: bool = False,
    parts: bool = False,
) -> Callable[[Run], Run]:
    """Make a function the command ``name`` of a group; its first argument is the command's ``Out``.

    Args:
        group: that gets it.
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
        group.command(name, cls=cls, epilog=f"Example: ethbrake {example}")(call)
        return run

    return register


def _option(parameter: Parameter, hint: Any) -> Parameter:
    """A parameter as Typer reads it, with the shared option of its name where it brings none."""
    if get_origin(hint) is not Annotated and hint is not typer.Context:
        hint = Annotated[hint, OPTIONS[parameter.name]]
    return parameter.replace(annotation=hint, kind=Parameter.KEYWORD_ONLY)


def new_group(name: str, about: str, *examples: str, inside: typer.Typer | None = None) -> typer.Typer:
    """A group of commands, in ``ethbrake`` or inside another group; its help page shows the examples."""
    shown = "\n\n".join(f"Example: ethbrake {example}" for example in examples)
    group = typer.Typer(cls=Group, rich_markup_mode=None, help=about, epilog=shown)
    (app if inside is None else inside).add_typer(group, name=name)
    return group


def schema_option(schema: Callable[[], dict[str, Any]]) -> Any:
    """The option ``--schema`` of a command that reads files of one kind: print their JSON Schema and exit."""

    def show_schema(asked: bool) -> None:
        if asked:
            Out().print_json(schema())
            raise typer.Exit

    told = "Print the JSON Schema of the file, and exit."
    return Annotated[bool, typer.Option("--schema", is_eager=True, callback=show_schema, help=told)]


class CommandWithParts(TyperCommand):
    """A command whose help ends with the names that recipes and scenarios may have."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """The epilog, and the names behind it; nothing can be registered where the physics is not even imported."""
        super().format_epilog(ctx, formatter)
        with formatter.section("What recipes and scenarios may name"):
            formatter.write_dl(part_names() if "ethbrake_marl.physics" in sys.modules else PARTS)


def part_names() -> list[tuple[str, str]]:
    """Kinds of parts, each with its names; what is registered is among them."""
    from ethbrake_marl.evaluation.measures import REGISTERED
    from ethbrake_marl.harm import KINDS
    from ethbrake_marl.learning.recipe import algorithm_names
    from ethbrake_marl.rewards import TERMS
    from ethbrake_marl.scenario.features import FEATURES
    from ethbrake_marl.scenario.v2x import CHANNELS

    own = [name if entry.of == "own" else f"front_K.{name}, rear_K.{name}" for name, entry in FEATURES.items()]
    return [
        ("Reward terms", ", ".join(TERMS)),
        ("Observation", ", ".join(["own", "front_K", "rear_K", "role", "obstacle", *own])),
        ("V2X presets", ", ".join(CHANNELS)),
        ("Objectives", ", ".join(kind.form for kind in KINDS.values())),
        ("Algorithms", ", ".join(algorithm_names())),
        *([("Measures", ", ".join(REGISTERED))] if REGISTERED else []),
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
        k = 0
        while k < len(args) and args[k].partition("=")[0] == "--plugin":
            k += 1 if "=" in args[k] else 2
        default, word = self.default, args[k] if k < len(args) else ""
        named = word in (*self.commands, "-h", "--help") or (not word and ctx.resilient_parsing)
        if default is not None and not named:
            takes_words = any(isinstance(each, TyperArgument) for each in default.params)
            if not word or word.startswith("-") or takes_words:
                args = [*args[:k], default.name, *args[k:]]
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


app = typer.Typer(
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


def _load_all(sources: list[str] | None) -> None:
    with redirect_stdout(sys.stderr):
        for source in sources or ():
            register_environments()
            load_plugin(source)


PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="FILE.py|NAME",
        help="Load this file, or installed plug-in, first: it is code, and can do what you can. Repeatable.",
        is_eager=True,  # before the values of other options are looked at
        expose_value=False,
        callback=_load_all,
    ),
]


def whole_command() -> Any:
    """All commands, users' own among them, with ``--plugin`` on each and on every group.

    Raises ``AlreadyExists`` for a command of somebody's that would take the place of another one.
    """
    names = [each.name or each.callback.__name__.replace("_", "-") for each in app.registered_commands if each.callback]
    names += [str(group.name) for group in app.registered_groups]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise AlreadyExists(f"command {name!r} is there already; give yours another name: app.command('my-{name}')")
    only_option = typer.Typer(add_completion=False)

    @only_option.command()
    def takes_plugins(plugin: PluginOption = None) -> None:
        """Nothing but the option, as Typer makes it."""

    (option,) = get_command(only_option).params
    whole = get_command(app)
    for each in _all(whole):
        each.params.append(option)
    return whole


def _all(command: Any) -> Iterator[Any]:
    """A command, and every one inside it."""
    yield command
    for each in getattr(command, "commands", {}).values():
        yield from _all(each)
