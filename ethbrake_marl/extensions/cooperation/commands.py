"""The commands ``study ablate``, which compares levels of cooperation, and ``study front``: whose harm counts?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from ethbrake_marl.cli.command import ForceOption, JobsOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.errors import InvalidInput

DEFAULT_AGENTS = "e_v2x_bm,plan"  # agents that are compared with the front if the scenario has one learner
AFTER_STOPPED_STUDY = "the same command continues the work in this folder"


study_group = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    help="Compare levels of cooperation, or whose harm counts.",
    epilog=example("study ablate --quick --output runs/ablation-quick", "study front --output runs/front"),
)


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


@study_group.command(
    "front",
    epilog=example(
        "study front --output runs/front",
        "study front --weights 1,1,1 --weights 4,1,1 --agents vine-preference --output runs/two",
    ),
)
def front_command(
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")],
    scenario: Annotated[
        str, typer.Option(metavar="NAME|PATH", help="Scenario; the search controls its learners.")
    ] = "paper-random",
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Agents to compare with the Pareto front.",
            show_default="e_v2x_bm,plan with one learner, else none",
        ),
    ] = None,
    weights: Annotated[
        list[str] | None,
        typer.Option(
            metavar="W1,W2,...",
            help="Choice of weights: one weight for each vehicle. Repeat the option for more choices.",
            show_default="a grid",
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option(help="Number of steps from weight 0 to weight 1 in the default grid.", min=1, max=50)
    ] = 5,
    episodes: Annotated[int, typer.Option(help="Number of worlds.", min=2)] = 500,
    seed: Annotated[int, typer.Option(help="Seed with which the worlds are drawn.", min=0)] = 7,
    budget: Annotated[
        int, typer.Option(help="Number of profiles that the search tries per world and choice of weights.", min=1)
    ] = 3000,
    settings: SettingsOption = None,
    jobs: JobsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show how sparing one vehicle changes the harm of the others.

    For each choice of weights, a search looks in every world for the commands with the least weighted honest cost (with
    --set harm_count=first: first-impact harm). Beside them stand full braking, maximin (the least that the largest cost
    of a vehicle can be) and agents, each of which drives all learners. The default weights are a grid, equal weights,
    and, for each vehicle, 1 with a tiny weight for all others. The command writes front.json and front.png.
    """
    with Out(as_json=as_json, force=force) as out:
        import numpy as np

        from ethbrake_marl.agent_names import split_specs
        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.episode.counts import HONEST, HarmCount
        from ethbrake_marl.extensions.cooperation.front import (
            FRONT_CHUNK,
            corners,
            least_largest,
            search_front,
            weight_grid,
        )
        from ethbrake_marl.extensions.cooperation.front_results import (
            front_figure,
            front_results,
            front_sheet,
            full_braking,
            hypervolume_sheet,
        )
        from ethbrake_marl.extensions.report.style import picture_bytes
        from ethbrake_marl.files.store import check_folder
        from ethbrake_marl.files.yaml import parse_yaml
        from ethbrake_marl.interrupts import stop_on_signal
        from ethbrake_marl.worlds.sampling import merge_draws

        changes = read_settings(settings, of_command=("harm_count",))
        chosen, count = changes.change_scenario(scenario), changes.command.get("harm_count", HONEST)
        rows: Any
        if weights is None:
            N = chosen.vehicles
            rows = np.concatenate([weight_grid(N, steps), np.ones((1, N)), corners(N)])
        else:
            rows = [parse_yaml(f"[{text}]", "--weights").content for text in weights]
        check_folder(output, ("front.json", "front.png"), force=force)
        drawn_worlds = chosen.draw(episodes, seed)
        names = DEFAULT_AGENTS if agents is None and len(chosen.learners) == 1 else agents or ""
        compared_agents = [spec for spec in split_specs(names) if spec != "full_brake"] if names else []

        def tell(searches: int, total: int) -> None:
            if searches == 0:  # all input has been checked
                out.note(
                    f"front: {total:,} searches with {budget * len(rows) * episodes:,} candidates or more (--episodes"
                    f" 100 --steps 1: {budget * (2 * chosen.vehicles + 1) * 100:,}); Ctrl-C keeps the finished worlds,"
                    f" which are searched {FRONT_CHUNK} at a time"
                )
            out.progress("front", searches, total)

        with stop_on_signal() as stop:
            front = search_front(
                chosen, drawn_worlds.worlds, rows, harm_count=HarmCount.of(count), budget=budget, threads=jobs or 1,
                agents=compared_agents, on_progress=tell, stop=stop,
            )  # fmt: skip
        n = front.amounts.shape[1]
        drawn_worlds = merge_draws([drawn_worlds], np.arange(n))
        largest = least_largest(chosen, drawn_worlds.worlds, front, budget=budget, threads=jobs or 1)
        beside = {"full_brake": full_braking(chosen, drawn_worlds), "maximin": largest}
        results = front_results(front, chosen, drawn_worlds, beside, seed)
        results |= {"budget": budget, "settings": list(settings or ())}
        with out.writing():
            output.mkdir(parents=True, exist_ok=True)
            out.write(output / "front.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
            out.write(output / "front.png", picture_bytes(front_figure(results), "front.png"), "figure")
        out.result(results, front_sheet(results), hypervolume_sheet(results), in_file=True)
        if n < episodes:
            out.interrupted(f"interrupted; the results are those of the first {n:,} worlds")
