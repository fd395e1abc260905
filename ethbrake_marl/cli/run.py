"""The command ``ethbrake run``: train, shield, compare, report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import (
    ForceOption,
    JsonOption,
    NameOption,
    OutputOption,
    RecipeOption,
    ScenarioOption,
    SetOption,
    StepsOption,
    StopWhenLostOption,
    TrainingSeedOption,
    VehicleOption,
)
from ethbrake_marl.cli.terminal import interruptible, progress_bars, say, write_json
from ethbrake_marl.cli.train import KEPT, end_of_training
from ethbrake_marl.defaults import EPISODES, LIST_SEED

if TYPE_CHECKING or LATE:
    from ethbrake_marl.cli.results import show_beside, show_rows
    from ethbrake_marl.evaluation.inputs import load_driven
    from ethbrake_marl.evaluation.results import PER_WORLD, results_to_json
    from ethbrake_marl.learning.recipe import load_recipe, read_settings


def run_experiment_command(
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
        chosen, plan = load_driven(scenario, vehicle, given.scenario), given.change(plan, say)
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
    if as_json:
        write_json(results_to_json(result.rows, per_world=result.directory / PER_WORLD))
    else:
        show_rows(result.rows)
        show_beside(result.beside)
    say(f"report: {result.report}")
    end_of_training(result.status, result.steps, folder)
