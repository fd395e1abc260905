"""The program ``ethbrake`` with all its commands: set up streams, run the command, turn errors into messages."""

from __future__ import annotations

import gc
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import cache
from typing import Annotated, Any

import typer
from typer.completion import shell_complete
from typer.core import TyperCommand
from typer.exceptions import TyperException
from typer.main import get_command, get_group

from ethbrake_marl import __version__
from ethbrake_marl.cli import agent, doctor, evaluate, run, scenario, train
from ethbrake_marl.cli.command import UNWRITTEN, Out, example, refuse
from ethbrake_marl.errors import EthBrakeError, describe_error, naming_extras
from ethbrake_marl.program import INTERRUPTED, raise_on_interrupt
from ethbrake_marl.registry import DISTRIBUTION, Registry, giver, points

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Ethical emergency braking: train, shield and evaluate agents. Every command has a --help with an example.",
    epilog=example("run", "evaluate --agents full_brake,e_v2x_bm --episodes 1000"),
)
_COMPLETE = "_ETHBRAKE_COMPLETE"  # variable with which a shell asks to complete a command line
_NAMES = "Names that can be used in --set, recipes and scenarios: ethbrake scenario list"
for name, command, usage in (
    ("run", run.experiment_command, "run --steps 200000 --seed 1"),
    ("train", train.train_command, "train --recipe sac --output runs/sac"),
    ("evaluate", evaluate.evaluate_command, "evaluate --agents full_brake,constant:3.5,e_v2x_bm --episodes 1000"),
    ("doctor", doctor.doctor_command, "doctor"),
):
    app.command(name, epilog=example(usage) + (f"\n\n{_NAMES}" if name in ("train", "evaluate") else ""))(command)
for name, group in (("scenario", scenario.scenario_group), ("agent", agent.agent_group)):
    app.add_typer(group, name=name)


def _show_version(wants_version: bool) -> None:
    if wants_version:
        Out().show(f"ethbrake {__version__}")
        raise typer.Exit


def _load_files(context: typer.Context, files: list[str] | None) -> None:
    from ethbrake_marl.files.python_file import load_file

    if not context.resilient_parsing:
        with redirect_stdout(sys.stderr):
            for file in files or ():
                load_file(file)


@app.callback()
def _about(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version and exit.")
    ] = False,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE.py",
            is_eager=True,
            callback=_load_files,
            help="Run a Python file that registers your own components (docs/extend.md). Can be given several times.",
        ),
    ] = None,
) -> None:
    """Show the version, or load files."""


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy starts threads of its own: one core unless asked
    gc.set_threshold(20_000)  # Python's default of 700 costs a run 1.5 CPU-s, and there are hardly any reference cycles
    prepare_streams()
    raise_on_interrupt()
    status = run_command(sys.argv[1:])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command has ended
    sys.exit(status)


def run_command(arguments: Sequence[str]) -> int:
    """Run the command line ``ethbrake ARGUMENTS``, and return the exit status.

    0: success. 1: the program that reads the output has closed the pipe. 2: wrong usage or invalid input. 3: a file or
    stdout cannot be written. 2 and 3 are explained in one line on stderr. 130: Ctrl-C. A command may choose another
    status. Every other exception is a bug of this program and is raised.
    """
    try:
        status = _status_of(arguments)
        sys.stdout.flush()
    except typer.Abort:
        Out().note("Aborted!")
        return 1
    except TyperException as error:
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "ethbrake"
        message = re.sub(r"Value error, |, unable to parse string as an? \w+", "", error.format_message())
        message = message.replace("Input should be", "must be").replace("a valid integer", "a whole number")
        return refuse(f"{message} (see: {where} --help)")
    except EthBrakeError as error:
        return refuse(str(error))
    except OSError as error:
        abandon_output()
        if isinstance(error, BrokenPipeError):
            return 1
        return refuse(error, UNWRITTEN)
    except MemoryError as error:
        return refuse(f"not enough memory{f' ({error})' if str(error) else ''}; use fewer worlds at once")
    except KeyboardInterrupt:
        Out().note("interrupted; repeat the command")
        return INTERRUPTED
    except Exception:
        raise
    except BaseException as error:  # GeneratorExit and similar, which this package never raises
        return refuse(f"your own code ended the process: {describe_error(error)}")
    return status


def _status_of(arguments: Sequence[str]) -> int:
    """Typer, or a command of another package, may raise ``SystemExit`` to set it."""
    try:
        with naming_extras():
            command = whole_command()
            if _COMPLETE in os.environ and ("COMP_WORDS" in os.environ or "_TYPER_COMPLETE_ARGS" in os.environ):
                return shell_complete(command, {}, "ethbrake", _COMPLETE, os.environ[_COMPLETE])
            with command.make_context("ethbrake", [*arguments]) as context:
                command.invoke(context)
    except typer.Exit as stop:
        return stop.exit_code
    except SystemExit as stop:
        if isinstance(stop.code, str):
            Out().note(stop.code)
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def prepare_streams() -> None:
    """Characters that stdout's encoding lacks, such as m², are printed as ``?``. Text that libraries and child
    processes write to stdout without Python's ``sys.stdout`` goes to stderr. Each warning of this package is printed on
    one line.
    """
    for name, mode in (("stdin", "r"), ("stdout", "r"), ("stderr", "w")):  # a closed stdout refuses results
        if getattr(sys, name) is None:  # closed by the caller: keep its number from the next file that is opened
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
        if sys.stdout is sys.__stdout__:
            buffering = 1 if sys.stdout.line_buffering else -1
            sys.stdout = os.fdopen(os.dup(1), "w", buffering, sys.stdout.encoding, "replace", closefd=False)
            os.dup2(2, 1)
    default_hook = warnings.showwarning

    def show_warning(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if category.__module__ == EthBrakeError.__module__:
            Out().note(f"warning: {message}")
        else:
            default_hook(message, category, *place, **more)

    warnings.showwarning = show_warning


def abandon_output() -> None:
    """Otherwise Python would raise an error at exit, for a full disk."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def add_command(name: str, command: typer.Typer | Callable[..., Any], *, epilog: str | None = None) -> None:
    """Add the command ``ethbrake NAME``. Packages use the entry-point group ``ethbrake_marl.commands`` instead.

    Args:
        name: ``NAME``, or ``GROUP.NAME`` for a command inside an existing group of commands.
        command: a function that Typer's ``app.command`` accepts, or a ``Typer`` object with several commands.
        epilog: text at the end of the help page, if ``command`` is a function.

    """
    if isinstance(command, typer.Typer):
        group = command
    else:
        group = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        group.command(epilog=epilog)(command)
    built = get_command(group)
    COMMANDS.add(name, built, lambda registered: registered is built)


_OURS = (*(str(info.name) for info in app.registered_commands), *(str(info.name) for info in app.registered_groups))
COMMANDS: Registry[Any] = Registry("command", "commands", add_command, dict.fromkeys(_OURS))


class Installed(TyperCommand):
    """Its code is imported only when the command is called.

    ``entry``: name of the command's entry point, ``NAME`` or ``GROUP.NAME``.
    """

    def __init__(self, entry: str) -> None:
        givers = [giver(point) for point in points(COMMANDS.group)[entry]]
        packages = f"package{'s' if len(givers) > 1 else ''} {' and '.join(givers)}"
        super().__init__(entry.rpartition(".")[2], help=f"Command of the installed {packages}.", rich_markup_mode=None)
        self.entry, self.is_ours = entry, givers == [DISTRIBUTION]

    def command(self) -> Any:
        command = COMMANDS[self.entry]
        command.name = self.name
        return with_load(with_installed(command, self.entry), load_option(whole_command()))

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        return self.command().make_context(*arguments, **settings)

    def get_short_help_str(self, limit: int = 45) -> str:
        """Another package is only named, not imported."""
        return str(self.command().get_short_help_str(limit) if self.is_ours else super().get_short_help_str(limit))


def with_installed(group: Any, name: str) -> Any:
    """Adds the installed commands with entry points ``NAME.COMMAND``."""
    for entry in points(COMMANDS.group):
        owner, _, command_name = entry.rpartition(".")
        if owner == name:
            group.commands[command_name] = Installed(entry)
    return group


def whole_command() -> Any:
    return _build_commands(*COMMANDS, *COMMANDS.loaded.values())


@cache
def _build_commands(*registered: object) -> Any:
    """Built once (100 ms) as long as the same names and commands are registered."""
    program: Any = get_command(app)
    for name in _OURS:
        with_installed(program.commands[name], name)
    added = [*points(COMMANDS.group), *(name for name in COMMANDS if name not in _OURS)]
    program.commands |= {name: COMMANDS.loaded.get(name) or Installed(name) for name in added if "." not in name}
    group_names = dict.fromkeys(entry.partition(".")[0] for entry in points(COMMANDS.group))
    for name in (group_name for group_name in group_names if group_name not in program.commands):
        group = get_group(typer.Typer(name=name, help="Commands of installed packages.", add_completion=False))
        program.commands[name] = with_installed(group, name)
    program.commands["doctor"] = program.commands.pop("doctor")  # the last one of the help
    load = load_option(program)
    load.expose_value = False
    return with_load(program, load)


def load_option(program: Any) -> Any:
    """The option ``--load``, which all commands share."""
    return next(option for option in program.params if option.name == "load")


def with_load(command: Any, load: Any) -> Any:
    """The command, or each of a group that is not ``Installed``, with the option ``load``."""
    if hasattr(command, "commands"):
        for inside in command.commands.values():
            with_load(inside, load)
    elif not isinstance(command, Installed) and all(option.name != load.name for option in command.params):
        command.params.append(load)
    return command
