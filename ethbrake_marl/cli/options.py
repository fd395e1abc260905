"""Options that several commands share: one place for their names, types and help."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ethbrake_marl import __version__
from ethbrake_marl.cli.terminal import show, write_json
from ethbrake_marl.defaults import EPISODES, LIST_SEED, UNCERTAINTY_EXAMPLE, HarmCount

ScenarioOption = Annotated[
    str,
    typer.Option("--scenario", metavar="NAME|PATH", help="A shipped or registered scenario, or a path to a YAML file."),
]
RecipeOption = Annotated[
    str, typer.Option("--recipe", metavar="NAME|PATH", help="A shipped recipe, or a path to a YAML file.")
]
SchemeOption = Annotated[
    str | None,
    typer.Option(
        metavar="single|shared|independent|centralised",
        help="How several learners are trained together.",
        show_default="the recipe's; else single, or shared for several learners",
    ),
]
StepsOption = Annotated[int | None, typer.Option(help="Training steps (decisions).", show_default="the recipe's")]
TrainingSeedOption = Annotated[
    int | None, typer.Option("--seed", help="Seed of the training alone.", show_default="the recipe's")
]
StopWhenLostOption = Annotated[
    bool, typer.Option("--stop-when-lost", help="Stop, resumable, when harm comes back and stays.")
]
NameOption = Annotated[
    str | None, typer.Option(help="Folder of the run inside runs/.", show_default="SCENARIO-RECIPE-seedSEED")
]
OutputOption = Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the run, instead of --name.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what is already there.")]
UncertaintyOption = Annotated[
    str | None,
    typer.Option(
        metavar="QUANTITY=WIDTH,...", help=f"What the robust shield does not know, such as {UNCERTAINTY_EXAMPLE}."
    ),
]
AgentsOption = Annotated[str, typer.Option(metavar="A,B,...", help="Who drives, with commas between them.")]
ListEpisodesOption = Annotated[int | None, typer.Option(help="Worlds of the list.", show_default=str(EPISODES))]
ListSeedOption = Annotated[int | None, typer.Option(help="Seed of the list.", show_default=str(LIST_SEED))]
HarmCountOption = Annotated[HarmCount, typer.Option(help="Harm that agents minimise: first impacts only, or all.")]
StatesOption = Annotated[
    Path | None, typer.Option(metavar="CSV|YAML", help="Your own worlds: one per row, or named ones of falsify.")
]
PerWorldOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also write one row per world and agent (.csv, .parquet), and FILE.json."),
]
ObjectiveOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Also tell the results under this objective; standard: under all usual ones. Repeatable.",
    ),
]
GroupOption = Annotated[
    str | None,
    typer.Option(metavar="COLUMN", help="Also tell the results by group: scenario (a mixture), vehicle_2_type."),
]
VehicleOption = Annotated[
    str | None, typer.Option(help="Who is driven; other learners brake fully.", show_default="the learner")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Another value of the scenario, or of the recipe: mass_t=40. Repeatable."
    ),
]
JobsOption = Annotated[
    int, typer.Option("--jobs", min=1, max=64, help="So many at once, a process each; changes no result.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON, and nothing else, on stdout.")]


def schema_option(schema: Callable[[], dict[str, Any]]) -> Any:
    """The option ``--schema`` of a command that reads files of one kind: print their JSON Schema and exit."""

    def show_schema(asked: bool) -> None:
        if asked:
            write_json(schema())
            raise typer.Exit

    told = "Print the JSON Schema of the file, and exit."
    return typer.Option("--schema", is_eager=True, callback=show_schema, help=told)


def _show_version(asked: bool) -> None:
    if asked:
        show(f"ethbrake {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version and exit.")
]
