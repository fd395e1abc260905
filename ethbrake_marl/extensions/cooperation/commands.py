"""The command ``study ablate``, which compares levels of cooperation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import JobsOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.errors import InvalidInput

AFTER_STOPPED_STUDY = "the same command continues the work in this folder"


study_group = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    help="Compare levels of cooperation.",
    epilog=example(
        "study ablate --quick --output runs/ablation-quick",
        "study ablate --sweep objective=social:0..90:15 --output runs/angle",
    ),
)


@study_group.callback()
def _a_group_of_one() -> None:
    """Compare levels of cooperation."""


@study_group.command(
    "ablate",
    epilog=example(
        "study ablate --quick --output runs/ablation-quick",
        "study ablate --sweep objective=social:0..90:15 --output runs/angle",
    ),
)
def ablate_command(
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")],
    levels: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Levels (scenarios) to compare, in this order.",
            show_default="the shipped levels; for a sweep cooperation-3-pair",
        ),
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=LOW..HIGH:STEP|A,B,...",
            help="Compare one level with several values of one key, for instance objective=social:0..90:15.",
        ),
    ] = None,
    recipes: Annotated[str, typer.Option(metavar="A,B,...", help="Training recipes.")] = "cooperation",
    seeds: Annotated[
        int | None, typer.Option(help="Number of training runs (seeds) per level and recipe.", show_default="5", min=1)
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(help="Number of decisions of each learner in one training run.", show_default="400000", min=1),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Number of worlds in which the levels are compared.", show_default="4000", min=1)
    ] = None,
    search_episodes: Annotated[
        int | None,
        typer.Option(
            help="Number of worlds, at most --episodes, in which the joint optimum is searched.",
            show_default="600",
            min=1,
        ),
    ] = None,
    settings: SettingsOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="For a quick try: few seeds, worlds and decisions.")] = False,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare several levels of cooperation in the same worlds.

    The command trains policies at all levels, compares the levels by both harms and the honest cost, and writes
    ablation.json, ablation.csv and the figure ablation.png. After an interruption, repeat the command to continue.

    The policies minimise what the recipe counts; with --set harm_count=first first-impact harm.

    With --sweep, the levels are copies of one scenario in which one key has different values.
    """
    with Out(as_json=as_json, remains=AFTER_STOPPED_STUDY) as out:
        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.cli.train import change_recipe
        from ethbrake_marl.extensions.cooperation.ablation import (
            FULL,
            QUICK_SETTINGS,
            Ablation,
            measure,
            train_all,
            with_optima,
        )
        from ethbrake_marl.extensions.cooperation.levels import STANDARD, SWEEP_LEVEL, read_levels, sweep_levels
        from ethbrake_marl.extensions.cooperation.results import ablation_results, tables, write_ablation
        from ethbrake_marl.training.recipe import load_recipe

        if sweep is not None and len(sweep) > 1:
            raise InvalidInput("--sweep is given twice; give it once, because the figures can show only one swept key")
        loaded = [load_recipe(name.strip()) for name in recipes.split(",")]
        changes = read_settings(settings, [key for recipe in loaded for key in type(recipe).model_fields])
        changed_recipes = [change_recipe(recipe, changes.recipe) for recipe in loaded]
        changed_recipes = [recipe if recipe.scheme else recipe.replace(scheme="shared") for recipe in changed_recipes]
        usual = ",".join(STANDARD) if sweep is None else SWEEP_LEVEL
        names = [name.strip() for name in (levels or usual).split(",")]
        if sweep is not None and len(names) != 1:
            raise InvalidInput(f"levels: {len(names)} levels given; a sweep needs exactly one level")
        compared = (
            read_levels(names, changes) if sweep is None else sweep_levels(names[0], sweep[0], changes, changed_recipes)
        )
        options = {
            "seeds": seeds, "steps_per_learner": steps, "episodes": episodes, "search_episodes": search_episodes,
        }  # fmt: skip
        numbers = {
            **(QUICK_SETTINGS if quick else FULL),
            **{key: value for key, value in options.items() if value is not None},
        }
        plan = Ablation(output, tuple(compared), tuple(changed_recipes), noted=changes.texts, **numbers)
        with plan.study_folder():
            if not train_all(plan, jobs or 1, out.show_progress):
                out.interrupted(f"interrupted; {AFTER_STOPPED_STUDY}")
            measured = with_optima(plan, measure(plan, out.show_progress), jobs or 1, out.show_progress)
            results = ablation_results(plan, measured)
            with out.writing():
                out.note(f"results: {', '.join(map(str, write_ablation(plan, measured, results)))}")
        alarms = [Text(line, "bold red") for line in results["undertrained"]]
        out.result(results, *tables(results), results["conditions"], *alarms, in_file=True)
