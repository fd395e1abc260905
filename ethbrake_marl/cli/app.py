"""The command ``ethbrake``: parse, call, print. Figures as JSON go to stdout alone, everything else to stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer.exceptions import TyperException
from typer.main import get_command

from ethbrake_marl.cli.ablate import ablate_command, generalise_command
from ethbrake_marl.cli.bench import bench_command
from ethbrake_marl.cli.best_harm import best_harm_command
from ethbrake_marl.cli.compare import compare_command
from ethbrake_marl.cli.dataset import dataset_command
from ethbrake_marl.cli.doctor import diagnose
from ethbrake_marl.cli.equal_time import equal_time_command
from ethbrake_marl.cli.evaluate import agents_command, evaluate_command, shield_command, show_beside, show_rows
from ethbrake_marl.cli.explore import explore_command
from ethbrake_marl.cli.options import (
    ForceOption,
    JsonOption,
    NameOption,
    OutputOption,
    RecipeOption,
    ScenarioOption,
    StepsOption,
    StopWhenLostOption,
    TrainingSeedOption,
    VehicleOption,
    VersionOption,
    rename_old_options,
)
from ethbrake_marl.cli.parts import CommandWithParts
from ethbrake_marl.cli.picture import picture_app
from ethbrake_marl.cli.plugins import accept_plugins, check_commands
from ethbrake_marl.cli.recipe import recipe_app
from ethbrake_marl.cli.record import record_command
from ethbrake_marl.cli.replay import replay_command
from ethbrake_marl.cli.reproduce import reproduce_command
from ethbrake_marl.cli.settings import SetOption, read_settings
from ethbrake_marl.cli.terminal import (
    abandon_output,
    interruptible,
    progress_bars,
    say,
    shell_asks,
    show,
    tell_compilation,
    tell_old_spellings,
    tolerate_narrow_streams,
    write_json,
)
from ethbrake_marl.cli.train import (
    KEPT,
    end_of_training,
    export_command,
    import_legacy_command,
    learning_curves_command,
    resume_command,
    train_command,
)
from ethbrake_marl.errors import EthBrakeError, naming_extras
from ethbrake_marl.evaluation.inputs import (
    EPISODES,
    LIST_SEED,
    load_driven,
    load_runnable,
)
from ethbrake_marl.evaluation.per_world import PER_WORLD, write_output
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.yaml import SIZE_LIMIT
from ethbrake_marl.learning.recipe import load_recipe
from ethbrake_marl.scenario import (
    list_scenarios,
    load_scenario,
    new_scenario_text,
    scenario_json_schema,
    scenario_path,
)
from ethbrake_marl.scenario.catalogue import SHIPPED
from ethbrake_marl.scenario.sample import count_kinds

BAD_INPUT = 2
_NO_VARIABLE = ""  # by which no shell can ask for completion
CHECKED_DRAWS = 1000  # worlds that `scenario validate` draws
GENERALISE = "Example: ethbrake generalise --runs runs/cooperation-4-all-cooperation-seed0 --vehicles 3,5,10"

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Ethical emergency braking: train, shield, evaluate. Every command has its own --help with an example.",
    epilog="Example: ethbrake run",
)
scenario_app = typer.Typer(
    rich_markup_mode=None,
    help="Look at scenarios, check one, or start a new one.",
    epilog="Example: ethbrake scenario show paper-random",
)
app.add_typer(scenario_app, name="scenario")
app.add_typer(recipe_app, name="recipe")
app.add_typer(picture_app, name="picture")
app.command(
    "train",
    cls=CommandWithParts,
    epilog="Example: ethbrake train --scenario paper-random-early --steps 200000 --name early",
)(train_command)
app.command("resume", epilog="Example: ethbrake resume runs/paper-random-ppo-seed0")(resume_command)
app.command(
    "learning-curves", epilog="Example: ethbrake learning-curves --scenario paper-delay-low --output runs/low-delay"
)(learning_curves_command)
app.command("ablate", epilog="Example: ethbrake ablate --quick --output runs/ablation-quick")(ablate_command)
app.command("generalise", epilog=GENERALISE)(generalise_command)
app.command("export", epilog="Example: ethbrake export runs/early --onnx early.onnx")(export_command)
app.command(
    "import-legacy", epilog="Example: ethbrake import-legacy old.zip --output old --algorithm sac --i-trust-this-file"
)(import_legacy_command)
app.command("best-harm", epilog="Example: ethbrake best-harm --episodes 200 --budget 20000 --json")(best_harm_command)
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
app.command("bench", epilog="Example: ethbrake bench --quick")(bench_command)
app.command("equal-time", epilog="Example: ethbrake equal-time --episodes 200 --repeats 1")(equal_time_command)


def main() -> None:
    """Entry point: run the command line and exit with its status."""
    tolerate_narrow_streams()
    tell_old_spellings()
    tell_compilation()
    sys.exit(run_command(sys.argv[1:]))


def run_command(arguments: Sequence[str]) -> int:
    """Exit status of a command line: 2 with one line on stderr for bad input, bad usage or a file that fails.

    Other errors, which are defects, pass through.
    """
    try:
        check_commands(app)
        variable = None if shell_asks(os.environ) else _NO_VARIABLE  # None: the usual one
        command = accept_plugins(get_command(app))
        arguments = rename_old_options(arguments, command)
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


@app.command(epilog="Example: ethbrake run --steps 200000 --seed 1")
def run(
    scenario: ScenarioOption = "paper-random",
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    episodes: Annotated[int, typer.Option(help="Worlds of the evaluation list.")] = EPISODES,
    list_seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = LIST_SEED,
    recipe: RecipeOption = "quick",
    settings: SetOption = None,
    vehicle: VehicleOption = None,
    name: NameOption = None,
    output: OutputOption = None,
    stop_when_lost: StopWhenLostOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, shield it, compare with the baselines, report.

    Writes the run's folder: the policy, results as CSV and JSON, every world, three figures, and report.html. After
    one of the three tests (paper-random, -brake-only, -obstacle) the policy also drives the other two.
    Ctrl-C ends the training early, and what it has is evaluated; a second Ctrl-C stops at once.
    """
    with interruptible(KEPT):
        # Here and in other commands that learn: torch takes seconds to load, and no other command needs it.
        from ethbrake_marl.studies.experiment import run_experiment, run_folder

        plan = load_recipe(recipe)
        given = read_settings(settings, [plan])
        chosen, plan = load_driven(scenario, vehicle, given.scenario), given.change(plan)
        folder = run_folder(chosen, plan, seed=seed, name=name, output=output)
        with progress_bars() as bars:
            result = run_experiment(
                chosen,
                folder,
                recipe=plan,
                steps=steps,
                seed=seed,
                episodes=episodes,
                list_seed=list_seed,
                stop_when_lost=stop_when_lost,
                force=force,
                settings=given.texts,
                on_progress=bars.show_progress,
            )
    show_rows(result.rows, as_json, per_world=result.directory / PER_WORLD)
    if not as_json:
        show_beside(result.beside)
    say(f"report: {result.report}")
    end_of_training(result.status, result.steps, folder)


app.command(
    "evaluate",
    cls=CommandWithParts,
    epilog="Example: ethbrake evaluate --agents full_brake,constant:3.5,e_v2x_bm --episodes 1000",
)(evaluate_command)


@scenario_app.command("list", epilog="Example: ethbrake scenario list")
def scenario_list(as_json: JsonOption = False) -> None:
    """List the scenarios that have a name: that and the title, and the folder of those that a plug-in registers."""
    entries = list_scenarios()
    if as_json:
        write_json([{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries])
        return
    width = max(len(entry.name) for entry in entries)
    for entry in entries:
        show(f"{entry.name:{width}}  {entry.title}{'' if entry.origin == SHIPPED else f'  (from {entry.origin})'}")


@scenario_app.command("show", epilog="Example: ethbrake scenario show paper-random")
def scenario_show(scenario: Annotated[str, typer.Argument(metavar="NAME|PATH")]) -> None:
    """Print the YAML of a scenario that is in order."""
    load_scenario(scenario)
    show(read_plain(scenario_path(scenario), SIZE_LIMIT).decode("utf-8"), end="")


@scenario_app.command("validate", epilog="Example: ethbrake scenario validate my-scenario.yaml")
def scenario_validate(path: Annotated[str, typer.Argument(metavar="PATH|NAME")]) -> None:
    """Check a scenario: one line, OK or what is wrong."""
    scenario = load_runnable(path)
    sample = scenario.sample(CHECKED_DRAWS, LIST_SEED)
    learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners) or "none"
    counts = f"{CHECKED_DRAWS:,} worlds drawn, {sample.rejected:,} more refused for an early impact"
    show(f"OK  {scenario.name}: {scenario.vehicles} vehicles, learners: {learners}; {counts}{count_kinds(sample)}")


@scenario_app.command("new", epilog="Example: ethbrake scenario new my-scenario --based-on paper-distance")
def scenario_new(
    name: str,
    based_on: Annotated[str, typer.Option(metavar="NAME|PATH", help="Whose values to start from.")] = "paper-random",
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the new file.")] = Path(),
    force: ForceOption = False,
) -> None:
    """Write a commented NAME.yaml with every key."""
    file = output / f"{name}.yaml"
    write_output(file, new_scenario_text(name, based_on).encode(), force=force)
    say(f"written: {file}; change it, then: ethbrake scenario validate {file}")


@scenario_app.command("schema", epilog="Example: ethbrake scenario schema > scenario.schema.json")
def scenario_schema() -> None:
    """Print the JSON Schema of scenario files.

    For editors that complete and check YAML.
    """
    write_json(scenario_json_schema())


@app.command(epilog="Example: ethbrake doctor")
def doctor(
    warm_up: Annotated[
        bool, typer.Option("--warm-up", help="Compile all of the physics now, so that no later command waits for it.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check this installation: versions, folders, physics.

    One line per check, OK or FAIL; exit status 1 when any failed.
    """
    checks = diagnose(warm_up=warm_up)
    if as_json:
        write_json([asdict(check) for check in checks])
    else:
        width = max(len(check.name) for check in checks)
        for check in checks:
            show(f"{'OK' if check.ok else 'FAIL':4}  {check.name:{width}}  {check.detail}")
    if not all(check.ok for check in checks):
        raise typer.Exit(1)


def _refuse(reason: str) -> int:
    """Say why, in one line; gives the exit status."""
    say(f"ethbrake: error: {reason}")
    return BAD_INPUT
