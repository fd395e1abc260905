"""The command ``study ablate``: train and compare levels of cooperation."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import JobsOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.extensions.studies.commands import KEPT, FolderOption
from ethbrake_marl.registry import Part


def ablate_command(
    output: FolderOption,
    levels: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Scenarios to compare, in this order.", show_default="the shipped ladder"),
    ] = None,
    recipes: Annotated[str, typer.Option(metavar="A,B,...", help="Training recipes.")] = "cooperation",
    seeds: Annotated[
        int | None, typer.Option(help="Trainings per level and recipe, seeds 0, 1, ...", show_default="5", min=1)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Decisions per training, for each of its learners.", show_default="400000", min=1)
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Worlds on which all are measured.", show_default="4000", min=1)
    ] = None,
    search_episodes: Annotated[
        int | None, typer.Option(help="How many of these to search for the joint optimum.", show_default="600", min=1)
    ] = None,
    shield: Annotated[
        str | None,
        typer.Option(metavar="step", help="Also drive behind this shield, one for all learners.", show_default="none"),
    ] = None,
    settings: SettingsOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look: few seeds, worlds and decisions.")] = False,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Train levels of cooperation, compare them on common worlds.

    Prints first how long it will take. The same command goes on after an interruption: finished trainings are kept,
    begun ones go on. Writes ablation.html, ablation.md, ablation.csv, ablation.json and three figures.
    """
    with Out(as_json=as_json, kept=KEPT) as out:
        from ethbrake_marl.extensions.cooperation.ablation import ablation_cost, run_ablation
        from ethbrake_marl.extensions.cooperation.levels import plan_ablation
        from ethbrake_marl.extensions.studies.machine import this_machine

        plan = plan_ablation(
            levels, recipes, settings, quick=quick, tell=out.note, seeds=seeds, steps_per_learner=steps,
            episodes=episodes, search_episodes=search_episodes, shield=shield, folder=output,
        )  # fmt: skip
        plan.study_folder().check()
        out.note(ablation_cost(plan))
        written = run_ablation(plan, jobs or 1, str(this_machine()), out.show_progress)
        if written is None:
            out.interrupted(f"interrupted; {KEPT}")
        found, (page, text, *figures) = written
        alarms = [Text(line, "bold red") for line in found["undertrained"]]
        out.result(found, text.read_text("utf-8"), *alarms, end="")
        drawn = f"; figures: {', '.join(map(str, figures))}" if figures else ""
        out.note(f"page: {page}; tables: {text}{drawn}")


ABLATE = Part(ablate_command, epilog=example("study ablate --quick --output runs/ablation-quick"))
