"""The commands ``ethbrake recipe ...``: look at training recipes, check one, start a new one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption
from ethbrake_marl.cli.terminal import say, show, write_json

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.files.store import read_plain
    from ethbrake_marl.files.yaml import SIZE_LIMIT
    from ethbrake_marl.learning.recipe import (
        load_recipe,
        new_recipe_text,
        recipe_json_schema,
        recipe_path,
        shipped_recipes,
    )

recipe_app = typer.Typer(
    rich_markup_mode=None,
    help="Look at training recipes, check one, or start a new one.",
    epilog="Example: ethbrake recipe show ppo",
)


@recipe_app.command("list", epilog="Example: ethbrake recipe list")
def recipe_list(as_json: JsonOption = False) -> None:
    """List the shipped recipes: name, algorithm and title."""
    found = {name: (load_recipe(name), path) for name, path in shipped_recipes().items()}
    if as_json:
        write_json(
            [
                {"name": name, "algorithm": recipe.algorithm, "title": recipe.title, "path": str(path)}
                for name, (recipe, path) in found.items()
            ]
        )
        return
    width = max(map(len, found))
    for name, (recipe, _) in found.items():
        show(f"{name:{width}}  {recipe.algorithm:4}  {recipe.title}")


@recipe_app.command("show", epilog="Example: ethbrake recipe show ppo")
def recipe_show(recipe: Annotated[str, typer.Argument(metavar="NAME|PATH")]) -> None:
    """Print the YAML of a recipe that is in order."""
    load_recipe(recipe)
    show(read_plain(recipe_path(recipe), SIZE_LIMIT).decode("utf-8"), end="")


@recipe_app.command("validate", epilog="Example: ethbrake recipe validate my-recipe.yaml")
def recipe_validate(path: Annotated[str, typer.Argument(metavar="PATH|NAME")]) -> None:
    """Check a recipe: one line, OK or what is wrong."""
    recipe = load_recipe(path)
    others = ", ".join(name for name in recipe.schemes if name not in ("single", "shared"))
    scheme = recipe.scheme or f"single, or shared for several learners{f'; also {others}' if others else ''}"
    show(f"OK  {recipe.name}: {recipe.algorithm}, {recipe.total_steps:,} steps, seed {recipe.seed}, scheme {scheme}")


@recipe_app.command("new", epilog="Example: ethbrake recipe new my-recipe --based-on sac")
def recipe_new(
    name: str,
    based_on: Annotated[str, typer.Option(metavar="NAME|PATH", help="Whose values to start from.")] = "ppo",
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the new file.")] = Path(),
    force: ForceOption = False,
) -> None:
    """Write a commented NAME.yaml with every key."""
    file = output / f"{name}.yaml"
    write_output(file, new_recipe_text(name, based_on).encode(), force=force)
    say(f"written: {file}; change it, then: ethbrake recipe validate {file}")


@recipe_app.command("schema", epilog="Example: ethbrake recipe schema > recipe.schema.json")
def recipe_schema() -> None:
    """Print the JSON Schema of recipe files.

    For editors that complete and check YAML.
    """
    write_json(recipe_json_schema())
