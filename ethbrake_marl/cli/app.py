"""The command ``ethbrake``: parse, call, print. Figures as JSON go to stdout alone, everything else to stderr."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

import typer
from typer.exceptions import TyperException
from typer.main import get_command

from ethbrake_marl.cli.ablate import ablate_command, generalise_command
from ethbrake_marl.cli.agents import agents_command
from ethbrake_marl.cli.bench import bench_command
from ethbrake_marl.cli.benchmark import benchmark_command, leaderboard_command
from ethbrake_marl.cli.best_harm import best_harm_command
from ethbrake_marl.cli.compare import compare_command
from ethbrake_marl.cli.dataset import dataset_command
from ethbrake_marl.cli.doctor import doctor_command
from ethbrake_marl.cli.evaluate import evaluate_command, shield_command
from ethbrake_marl.cli.explore import explore_command
from ethbrake_marl.cli.falsify import falsify_command
from ethbrake_marl.cli.options import VersionOption
from ethbrake_marl.cli.parts import CommandWithParts
from ethbrake_marl.cli.picture import picture_app
from ethbrake_marl.cli.plugins import accept_plugins, check_commands, prepare_commands
from ethbrake_marl.cli.recipe import recipe_app
from ethbrake_marl.cli.record import record_command
from ethbrake_marl.cli.replay import replay_command
from ethbrake_marl.cli.reproduce import reproduce_command
from ethbrake_marl.cli.run import run_experiment_command
from ethbrake_marl.cli.scenario import scenario_app
from ethbrake_marl.cli.sweep import sweep_command
from ethbrake_marl.cli.terminal import (
    abandon_output,
    say,
    shell_asks,
    tell_compilation,
    tell_warnings,
    tolerate_narrow_streams,
)
from ethbrake_marl.cli.train import (
    export_command,
    learning_curves_command,
    resume_command,
    train_command,
)
from ethbrake_marl.cli.tune import tune_command
from ethbrake_marl.errors import EthBrakeError, naming_extras

BAD_INPUT = 2
_NO_VARIABLE = ""  # by which no shell can ask for completion
GENERALISE = "Example: ethbrake generalise --runs runs/cooperation-4-all-cooperation-seed0 --vehicles 3,5,10"

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Ethical emergency braking: train, shield, evaluate. Every command has its own --help with an example.",
    epilog="Example: ethbrake run",
)
app.add_typer(scenario_app, name="scenario")
app.add_typer(recipe_app, name="recipe")
app.add_typer(picture_app, name="picture")
app.command("run", epilog="Example: ethbrake run --steps 200000 --seed 1")(run_experiment_command)
app.command(
    "train",
    cls=CommandWithParts,
    epilog="Example: ethbrake train --scenario paper-random-early --steps 200000 --name early",
)(train_command)
app.command("resume", epilog="Example: ethbrake resume runs/paper-random-ppo-seed0")(resume_command)
app.command(
    "learning-curves", epilog="Example: ethbrake learning-curves --scenario paper-delay-low --output runs/low-delay"
)(learning_curves_command)
app.command("sweep", epilog="Example: ethbrake sweep sweep.yaml --output runs/sweep")(sweep_command)
app.command("tune", epilog="Example: ethbrake tune tuning.yaml --output runs/tuning --trials 30 --export best.yaml")(
    tune_command
)
app.command("ablate", epilog="Example: ethbrake ablate --quick --output runs/ablation-quick")(ablate_command)
app.command("generalise", epilog=GENERALISE)(generalise_command)
app.command("export", epilog="Example: ethbrake export runs/early --onnx early.onnx")(export_command)
app.command("best-harm", epilog="Example: ethbrake best-harm --episodes 200 --budget 20000 --json")(best_harm_command)
app.command(
    "evaluate",
    cls=CommandWithParts,
    epilog="Example: ethbrake evaluate --agents full_brake,constant:3.5,e_v2x_bm --episodes 1000",
)(evaluate_command)
app.command(
    "falsify",
    cls=CommandWithParts,
    epilog="Example: ethbrake falsify --agent ppo@shipped --against e_v2x_bm --output worst.yaml",
)(falsify_command)
app.command("compare", epilog="Example: ethbrake compare before.csv.json after.csv.json")(compare_command)
app.command("agents", epilog="Example: ethbrake agents")(agents_command)
app.command("shield", epilog="Example: ethbrake shield --agents ppo@shipped,full_brake --episodes 500")(shield_command)
app.command("reproduce", epilog="Example: ethbrake reproduce random-table harm-distance --quick --output runs/paper")(
    reproduce_command
)
app.command("record", epilog="Example: ethbrake record --agents full_brake,e_v2x_bm --world 3 --output both.gif")(
    record_command
)
app.command("dataset", epilog="Example: ethbrake dataset --agents best_harm --episodes 1000 --output best.parquet")(
    dataset_command
)
app.command("replay", epilog="Example: ethbrake replay PASSPORT --output again.html")(replay_command)
app.command("explore", epilog="Example: ethbrake explore --agents full_brake,ppo@shipped")(explore_command)
app.command("benchmark", epilog="Example: ethbrake benchmark v2 --agent ppo@shipped --output mine.json")(
    benchmark_command
)
app.command("leaderboard", epilog="Example: ethbrake leaderboard mine.json theirs.json --output table.html")(
    leaderboard_command
)
app.command("doctor", epilog="Example: ethbrake doctor")(doctor_command)
app.command("bench", epilog="Example: ethbrake bench --quick")(bench_command)


def main() -> None:
    """Entry point: run the command line and exit with its status."""
    gc.set_threshold(20_000)  # Python's 700 costs a run 1.5 CPU-s, and there is next to no garbage in circles
    tolerate_narrow_streams()
    tell_warnings()
    tell_compilation()
    sys.exit(run_command(sys.argv[1:]))


def run_command(arguments: Sequence[str]) -> int:
    """Exit status of a command line: 2 with one line on stderr for bad input, bad usage or a file that fails.

    Other errors, which are defects, pass through.
    """
    try:
        check_commands(app)
        variable = None if shell_asks(os.environ) else _NO_VARIABLE  # None: the usual one
        command = prepare_commands(accept_plugins(get_command(app)))
        with naming_extras():
            status = command(arguments, prog_name="ethbrake", standalone_mode=False, complete_var=variable)
        sys.stdout.flush()
    except SystemExit as stop:
        if shell_asks(os.environ):
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


@app.callback()
def _about(version: VersionOption = False) -> None:
    """Options of ``ethbrake`` itself."""


def _refuse(reason: str) -> int:
    """Say why, in one line; gives the exit status."""
    say(f"ethbrake: error: {reason}")
    return BAD_INPUT
