"""The command ``study front``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JobsOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.registry import Part

DEFAULT_AGENTS = "e_v2x_bm,universal"  # agents that are compared with the front if the scenario has one learner


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
            show_default="e_v2x_bm,universal with one learner, else none",
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
    --set rules=paper: first-impact harm). Beside them stand full braking, maximin (the least that the largest cost of a
    vehicle can be) and, if there is one learner, agents. The default weights are a grid, equal weights, and, for each
    vehicle, 1 with a tiny weight for all others. The command writes front.json and front.png.
    """
    with Out(as_json=as_json, force=force) as out:
        import numpy as np

        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.episode.counts import check_count
        from ethbrake_marl.extensions.fronts.figures import front_figure
        from ethbrake_marl.extensions.fronts.front import least_largest, search_front
        from ethbrake_marl.extensions.fronts.results import front_results, front_sheet, full_braking, hypervolume_sheet
        from ethbrake_marl.extensions.fronts.weights import corners, weight_grid
        from ethbrake_marl.extensions.report.style import picture_bytes
        from ethbrake_marl.files.store import check_folder
        from ethbrake_marl.files.yaml import parse_yaml
        from ethbrake_marl.names import split_specs

        changes = read_settings(settings, of_command=("harm_count",))
        chosen, count = changes.change_scenario(scenario), changes.command.get("harm_count", "honest")
        check_count("harm_count", count)
        rows: Any
        if weights is None:
            N = chosen.vehicles
            rows = np.concatenate([weight_grid(N, steps), np.ones((1, N)), corners(N)])
        else:
            rows = [parse_yaml(f"[{text}]", "--weights").content for text in weights]
        check_folder(output, ("front.json", "front.png"), force=force)
        drawn = chosen.draw(episodes, seed)
        names = DEFAULT_AGENTS if agents is None and len(chosen.learners) == 1 else agents or ""
        others = [spec for spec in split_specs(names) if spec != "full_brake"] if names else []
        front = search_front(
            chosen, drawn.worlds, rows, count=count, budget=budget, threads=jobs or 1, agents=others,
            on_progress=lambda done, total: out.progress("front", done, total),
        )  # fmt: skip
        largest = least_largest(chosen, drawn.worlds, front, budget=budget, threads=jobs or 1)
        beside = {"full_brake": full_braking(chosen, drawn), "maximin": largest}
        results = front_results(front, chosen, drawn, beside, seed)
        results |= {"budget": budget, "settings": list(settings or ())}
        output.mkdir(parents=True, exist_ok=True)
        out.write(output / "front.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
        out.write(output / "front.png", picture_bytes(front_figure(results), "front.png"), "figure")
        out.result(results, front_sheet(results), hypervolume_sheet(results), kept=True)


FRONT = Part(
    front_command,
    epilog=example(
        "study front --output runs/front",
        "study front --weights 1,1,1 --weights 4,1,1 --agents vine-preference --output runs/two",
    ),
)
