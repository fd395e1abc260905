"""The commands ``ethbrake ablate`` (what each step of cooperation is worth) and ``ethbrake generalise``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import JobsOption, JsonOption, ScenarioOption, SetOption
from ethbrake_marl.cli.terminal import INTERRUPTED, interruptible, progress_bars, say, show, write_json
from ethbrake_marl.defaults import LIST_SEED, HarmCount
from ethbrake_marl.errors import InvalidInput

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.learning.recipe import read_settings

if TYPE_CHECKING:
    from ethbrake_marl.studies.ablation import Plan

QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}
FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}
KEPT = "the same command goes on with what is in the folder"


def ablate_command(
    output: Annotated[Path, typer.Option("--output", metavar="FOLDER", help="Folder of everything.")],
    levels: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Scenarios in this order.", show_default="the shipped ladder")
    ] = None,
    recipes: Annotated[str, typer.Option(metavar="A,B,...", help="Training recipes.")] = "cooperation",
    scheme: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="How several learners are trained.", show_default="the recipe's; else shared"
        ),
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Trainings of each, seeds 0, 1, ...", show_default="5")] = None,
    steps: Annotated[
        int | None, typer.Option(help="Decisions per training, for each of its learners.", show_default="400000")
    ] = None,
    episodes: Annotated[int | None, typer.Option(help="Common worlds to measure on.", show_default="4000")] = None,
    list_seed: Annotated[int, typer.Option(help="Seed of the common worlds.")] = LIST_SEED,
    search_episodes: Annotated[
        int | None, typer.Option(help="Worlds of the joint optimum, the first ones.", show_default="600")
    ] = None,
    budget: Annotated[
        int | None, typer.Option(help="Candidates per world and count of that search.", show_default="20000")
    ] = None,
    shield: Annotated[
        str | None,
        typer.Option(metavar="step", help="Also drive behind this shield, one for all learners.", show_default="none"),
    ] = None,
    settings: SetOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look: few seeds, worlds and decisions.")] = False,
    jobs: Annotated[int, typer.Option(help="Trainings at once; changes no result.")] = 1,
    cost: Annotated[bool, typer.Option("--cost", help="Say what is left to do and what it takes; stop.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train levels of cooperation, compare them on common worlds.

    Says first what it will take. The same command goes on after an interruption: finished trainings are kept, begun
    ones go on. Writes ablation.html, ablation.md, ablation.csv, ablation.json and three figures.
    """
    with interruptible(KEPT):
        # torch takes seconds to load, and no other command needs it
        from ethbrake_marl.studies.ablation import (
            LADDER,
            STANDARD,
            check_finished,
            cost_of,
        )

        chosen = dict(QUICK if quick else FULL)
        given = {"seeds": seeds, "steps_per_learner": steps, "episodes": episodes, "search_episodes": search_episodes}
        chosen |= {name: value for name, value in {**given, "budget": budget}.items() if value is not None}
        names = [*(LADDER if quick else STANDARD)] if levels is None else [each.strip() for each in levels.split(",")]
        if not 1 <= jobs <= 64:
            raise InvalidInput(f"jobs {jobs}: must be from 1 to 64")
        plan = _plan(names, recipes, scheme, settings, list_seed, output, shield, chosen)
        if not cost:
            plan.job_folder().check()
        check_finished(plan.trainings())
        say(str(cost_of(plan)))
        if not cost:
            _run(plan, jobs, as_json)


def generalise_command(
    runs: Annotated[
        str,
        typer.Option(metavar="RUN,RUN,...", help="Runs or bundles, seeds of one training."),
    ],
    scenario: ScenarioOption = "cooperation-4-all",
    vehicles: Annotated[
        str, typer.Option(metavar="N,N,...", help="Lengths of the lines; vehicle i > 3 is like vehicle i - 2.")
    ] = "3,4,5,6,7,8,9,10",
    episodes: Annotated[int, typer.Option(help="Worlds of each length.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the lists.")] = LIST_SEED,
    harm_count: Annotated[HarmCount, typer.Option(help="Harm: first impacts only, or all.")] = "total",
    search_episodes: Annotated[int, typer.Option(help="Worlds of the joint optimum; 0: none.")] = 0,
    budget: Annotated[int, typer.Option(help="Candidates per world of that search.")] = 20_000,
    settings: SetOption = None,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Let trained policies drive longer lines with the same weights.

    They drive every follower, and Vehicle 1 where it learns in the scenario.
    """
    # scipy's statistics take a second to load
    from ethbrake_marl.studies.ablation_report import LineQuestion, drive_longer, lines_markdown, load_runs

    lengths = _lengths(vehicles)
    if not episodes >= 1 or not 0 <= search_episodes <= episodes or not budget >= 1:
        raise InvalidInput(
            f"episodes {episodes}, search-episodes {search_episodes}, budget {budget}: must be at least 1, from 0 to"
            " the episodes, and at least 1"
        )
    line = load_runnable(scenario, read_settings(settings).scenario)
    agents = load_runs([each.strip() for each in runs.split(",")], line)
    question = LineQuestion(line, lengths, episodes, seed, harm_count, search_episodes, budget)
    with interruptible("nothing was written"), progress_bars() as bars:
        found = drive_longer(question, agents, bars.show_progress, jobs)
    if as_json:
        write_json([one.to_json() for one in found])
    else:
        show(lines_markdown(found, question, len(agents)), end="")


def _lengths(text: str) -> tuple[int, ...]:
    try:
        lengths = tuple(int(each) for each in text.split(","))
    except ValueError:
        lengths = ()
    if not lengths or not all(2 <= each <= 64 for each in lengths):
        raise InvalidInput(f"vehicles {text!r}: must be lengths from 2 to 64, for instance 3,4,5")
    return lengths


def _plan(
    names: list[str],
    recipes: str,
    scheme: str | None,
    settings: list[str] | None,
    list_seed: int,
    output: Path,
    shield: str | None,
    numbers: dict[str, int],
) -> Plan:
    from ethbrake_marl.learning.recipe import check_scheme, load_recipe, scheme_of
    from ethbrake_marl.studies.ablation import Plan, check_plan, common_worlds, read_levels, with_scheme
    from ethbrake_marl.studies.jobs import JobFolder

    chosen = None if scheme is None else check_scheme(scheme)
    loaded = [load_recipe(each.strip()) for each in recipes.split(",")]
    given = read_settings(settings, loaded)
    plan = Plan(
        levels=tuple(read_levels(names, given.scenario)),
        recipes=tuple(with_scheme(given.change(recipe, say), chosen) for recipe in loaded),
        noted=given.texts,
        list_seed=list_seed,
        folder=output,
        shield=shield,
        **numbers,
    )
    check_plan(plan)
    JobFolder(output, "an ablation").check()
    common_worlds(plan.levels, 5, list_seed)
    for training in plan.trainings():
        scheme_of(training.recipe, training.level.scenario)
    return plan


def _run(plan: Plan, jobs: int, as_json: bool) -> None:
    from ethbrake_marl.studies.ablation import run_ablation
    from ethbrake_marl.studies.ablation_report import FIGURES, PAGE, TEXT, write_ablation

    with progress_bars() as bars:
        measured = run_ablation(plan, jobs, bars.show_progress)
    if measured is None:
        say(f"interrupted; {KEPT}")
        raise typer.Exit(INTERRUPTED)
    found = write_ablation(plan, measured, str(this_machine()))
    if as_json:
        write_json(found)
    else:
        show((plan.folder / TEXT).read_text("utf-8"), end="")
    figures = ", ".join(str(plan.folder / name) for name in FIGURES if (plan.folder / name).is_file())
    say(f"page: {plan.folder / PAGE}; tables: {plan.folder / TEXT}" + (f"; figures: {figures}" if figures else ""))
