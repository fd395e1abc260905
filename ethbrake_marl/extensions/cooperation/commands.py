"""The command ``study ablate``: train and compare levels of cooperation."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import JobsOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.studies.commands import REMAINS, FolderOption
from ethbrake_marl.registry import Part


def ablate_command(
    output: FolderOption,
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
    shield: Annotated[
        str | None,
        typer.Option(
            metavar="step", help="Also evaluate the learners of each level with this shield.", show_default="none"
        ),
    ] = None,
    settings: SettingsOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="For a quick try: few seeds, worlds and decisions.")] = False,
    cost: Annotated[
        bool,
        typer.Option(
            "--cost",
            help="Estimate the time of the command by short trials, print it and the output folders, and exit.",
        ),
    ] = False,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare several levels of cooperation in the same worlds.

    The command first prints an estimate of its running time. The command then trains policies at all levels, compares
    the levels, and writes ablation.json, ablation.csv and the figure ablation.png. After an interruption, repeat the
    command to continue.

    With --sweep, the levels are copies of one scenario in which one key has different values.
    """
    with Out(as_json=as_json, remains=REMAINS) as out:
        from ethbrake_marl.extensions.cooperation.ablation import HOW_MEASURED, ablation_cost, run_ablation
        from ethbrake_marl.extensions.cooperation.levels import plan_ablation
        from ethbrake_marl.extensions.cooperation.results import tables
        from ethbrake_marl.extensions.studies.machine import this_machine

        if sweep is not None and len(sweep) > 1:
            raise InvalidInput("--sweep is given twice; give it once, because the figures can show only one swept key")
        plan = plan_ablation(
            levels, recipes, settings, sweep=sweep[0] if sweep else None, quick=quick, tell=out.note,
            seeds=seeds, steps_per_learner=steps, episodes=episodes, search_episodes=search_episodes, shield=shield,
            folder=output,
        )  # fmt: skip
        plan.study_folder().check()
        estimate = ablation_cost(plan)
        if cost:
            trainings, optimum = output / "trainings", output / "optimum"
            folders = f"folders: {estimate.training_folders} in {trainings}, {estimate.search_folders} in {optimum}"
            measured = f"measured: {HOW_MEASURED}"
            out.result({**estimate.to_json(), "measured": HOW_MEASURED}, str(estimate), folders, measured)
            return
        out.note(str(estimate))
        written = run_ablation(plan, jobs or 1, str(this_machine()), out.show_progress)
        if written is None:
            out.interrupted(f"interrupted; {REMAINS}")
        results, paths = written
        alarms = [Text(line, "bold red") for line in results["undertrained"]]
        out.result(results, *tables(results), results["conditions"], *alarms)
        out.note(f"results: {', '.join(map(str, paths))}")


ABLATE = Part(
    ablate_command,
    epilog=example(
        "study ablate --quick --output runs/ablation-quick",
        "study ablate --sweep objective=social:0..90:15 --output runs/angle --cost",
    ),
)
