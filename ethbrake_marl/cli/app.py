"""The command ``ethbrake``: parse, call, print. Figures as JSON go to stdout alone, everything else to stderr."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping, Sequence

from typer.exceptions import TyperException

from ethbrake_marl.cli import doctor, evaluate, scenario, search, study, train, watch
from ethbrake_marl.cli.command import app, whole_command
from ethbrake_marl.cli.out import abandon_output, prepare_streams, say
from ethbrake_marl.errors import EthBrakeError, naming_extras

__all__ = ["app", "doctor", "evaluate", "main", "run_command", "scenario", "search", "study", "train", "watch"]

BAD_INPUT = 2
_NO_VARIABLE = ""  # by which no shell can ask for completion


def main() -> None:
    """Entry point: run the command line and exit with its status."""
    gc.set_threshold(20_000)  # Python's 700 costs a run 1.5 CPU-s, and there is next to no garbage in circles
    prepare_streams()
    sys.exit(run_command(sys.argv[1:]))


def run_command(arguments: Sequence[str]) -> int:
    """Exit status of a command line: 2 with one line on stderr for bad input, bad usage or a file that fails.

    Other errors, which are defects, pass through.
    """
    asked = _shell_asks(os.environ)
    try:
        variable = None if asked else _NO_VARIABLE  # None: the usual one
        with naming_extras():
            status = whole_command()(arguments, prog_name="ethbrake", standalone_mode=False, complete_var=variable)
        sys.stdout.flush()
    except SystemExit as stop:
        if asked:
            raise
        return _refuse(f"code of yours ended the process: SystemExit: {stop.code}")
    except TyperException as error:
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "ethbrake"
        return _refuse(f"{error.format_message().replace('Value error, ', '')} (see: {where} --help)")
    except EthBrakeError as error:
        return _refuse(str(error))
    except OSError as error:
        abandon_output()
        return _refuse(f"{error.filename or 'output'!s:.200}: {error.strerror or error}")
    except MemoryError as error:
        return _refuse(f"not enough memory{f' ({error})' if str(error) else ''}; ask for fewer worlds at once")
    return status if isinstance(status, int) else 0


def _shell_asks(environment: Mapping[str, str]) -> bool:
    """Whether a shell's completion runs this command, as its script from ``--show-completion`` does.

    The variable alone, or with what no such script sets, is ignored: a command must not fail because of it.
    """
    if environment.get("_ETHBRAKE_COMPLETE") == "complete_bash":
        return "COMP_WORDS" in environment and environment.get("COMP_CWORD", "").isdecimal()
    others = ("complete_zsh", "complete_fish", "complete_powershell", "complete_pwsh")
    return environment.get("_ETHBRAKE_COMPLETE") in others and "_TYPER_COMPLETE_ARGS" in environment


def _refuse(reason: str) -> int:
    """Say why, in one line; gives the exit status."""
    say(f"ethbrake: error: {reason}")
    return BAD_INPUT
