"""The commands about what there is: ``scenario``, ``recipe`` and ``agent``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl import evaluation, learning, scenario as scenarios
from ethbrake_marl.cli.command import Out, app
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.store import read_plain

CHECKED_DRAWS = 1000  # worlds that `scenario validate` draws

NameArgument = Annotated[str, typer.Argument(metavar="NAME|PATH")]
NewNameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Of the new file.")]
BasedOnOption = Annotated[str, typer.Option(metavar="NAME|PATH", help="Whose values to start from.")]
FolderOption = Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the new file.")]

scenario_group = app.group(
    "scenario",
    "Look at scenarios, check one, start one, draw worlds.",
    "scenario show paper-random",
    "scenario sample paper-random --episodes 10 --output worlds.csv",
)


@scenario_group.add("list", "scenario list", json=True)
def scenario_list(out: Out) -> None:
    """List the scenarios that have a name.

    Name and title, and the folder of those that a plug-in registers.
    """
    entries = scenarios.list_scenarios()
    width = max(len(entry.name) for entry in entries)
    out.result(
        [{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries],
        *(f"{e.name:{width}}  {e.title}{'' if e.shipped else f'  (from {e.origin})'}" for e in entries),
    )


@scenario_group.add("show", "scenario show paper-random")
def scenario_show(out: Out, scenario: NameArgument) -> None:
    """Print the YAML of a scenario that is in order."""
    scenarios.load_scenario(scenario)
    _show_file(out, scenarios.scenario_path(scenario))


@scenario_group.add("validate", "scenario validate my-scenario.yaml", json=True)
def scenario_validate(out: Out, path: NameArgument) -> None:
    """Check a scenario.

    One line: OK, or what is wrong; then what may not be meant.
    """
    from ethbrake_marl.agents import Team, drive, make_agent

    scenario = evaluation.load_runnable(path)
    sample = scenario.sample(CHECKED_DRAWS, DEFAULT.LIST_SEED)
    names = [scenario.vehicle_names[i] for i in scenario.learners]
    free = {i for i, script in scenario.scripts.items() if scenarios.ScriptSpec.parse(script).is_state_free()}
    deciding = [i for i in range(scenario.vehicles) if i not in free]
    braking = Team.of(make_agent("full_brake"), deciding)
    moving = int((~drive(sample.worlds, braking, scenario).at_rest).sum())
    late = int((sample.worlds.vehicles.latency_s[:, 0] > 0.0).sum())
    told = {"name": scenario.name, "vehicles": scenario.vehicles, "learners": names, "worlds": CHECKED_DRAWS}
    counts = f"{CHECKED_DRAWS:,} worlds drawn, {sample.rejected:,} more refused for an early impact"
    learners = ", ".join(names) or "none"
    shown = [f"OK  {scenario.name}: {scenario.vehicles} vehicles, learners: {learners}; {counts}{sample.count_kinds()}"]
    if moving:
        shown.append(
            f"note: at the horizon ({scenario.horizon_s:g} s) something still moves in {moving:,} of them, though"
            " whoever decides brakes fully; what comes after counts nowhere. A longer horizon_s sees more"
        )
    if late:
        shown.append(f"note: Vehicle 1, whose braking is the alert, has a latency above 0 in {late:,} of them")
    out.result({**told, "rejected": sample.rejected, "moving_at_horizon": moving, "vehicle_1_late": late}, *shown)


@scenario_group.add("new", "scenario new my-scenario --based-on paper-distance", force=True)
def scenario_new(
    out: Out, name: NewNameArgument, based_on: BasedOnOption = "paper-random", output: FolderOption = Path()
) -> None:
    """Write a commented NAME.yaml with every key."""
    _write_new(out, "scenario", output / f"{name}.yaml", scenarios.new_scenario_text(name, based_on))


@scenario_group.add("schema", "scenario schema > scenario.schema.json")
def scenario_schema(out: Out) -> None:
    """Print the JSON Schema of scenario files.

    For editors that complete and check YAML.
    """
    out.print_json(scenarios.scenario_json_schema())


@scenario_group.add("sample", "scenario sample paper-random --episodes 10 --output worlds.csv", json=True, force=True)
def scenario_sample(
    out: Out,
    scenario: NameArgument,
    episodes: int = 10,
    seed: int = DEFAULT.LIST_SEED,
    settings: list[str] | None = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Write the table to this file.", show_default="stdout")
    ] = None,
) -> None:
    """Draw the first worlds of a list as a table.

    `ethbrake evaluate --initial-states` reads it. A column is what the scenario does not fix. The same list, seed and
    number are the same worlds on every machine.
    """
    out.check(output, ".csv", what="a table of worlds")
    chosen = evaluation.load_runnable(scenario, learning.read_settings(settings).scenario)
    states = evaluation.states_of(chosen.sample(episodes, seed).worlds, chosen)
    lines = [",".join(states[0]), *(",".join(map(repr, state.values())) for state in states)]
    if output is not None:
        out.write(output, "\n".join([*lines, ""]), what="worlds")
    if output is None or out.as_json:
        out.result(states, *lines)


recipe_group = app.group(
    "recipe",
    "Look at training recipes, check one, or start a new one.",
    "recipe show ppo",
    "recipe new my-recipe --based-on sac",
)


@recipe_group.add("list", "recipe list", json=True)
def recipe_list(out: Out) -> None:
    """List the shipped recipes: name, algorithm and title."""
    found = {name: (learning.load_recipe(name), path) for name, path in learning.TrainingRecipe.shipped().items()}
    width = max(map(len, found))
    out.result(
        [
            {"name": name, "algorithm": recipe.algorithm, "title": recipe.title, "path": str(path)}
            for name, (recipe, path) in found.items()
        ],
        *(f"{name:{width}}  {recipe.algorithm:4}  {recipe.title}" for name, (recipe, _) in found.items()),
    )


@recipe_group.add("show", "recipe show ppo")
def recipe_show(out: Out, recipe: NameArgument) -> None:
    """Print the YAML of a recipe that is in order."""
    learning.load_recipe(recipe)
    _show_file(out, learning.TrainingRecipe.file(recipe))


@recipe_group.add("validate", "recipe validate my-recipe.yaml")
def recipe_validate(out: Out, path: NameArgument) -> None:
    """Check a recipe: one line, OK or what is wrong."""
    recipe = learning.load_recipe(path)
    others = ", ".join(name for name in recipe.schemes if name not in ("single", "shared"))
    scheme = recipe.scheme or f"single, or shared for several learners{f'; also {others}' if others else ''}"
    out.show(
        f"OK  {recipe.name}: {recipe.algorithm}, {recipe.total_steps:,} steps, seed {recipe.seed}, scheme {scheme}"
    )


@recipe_group.add("new", "recipe new my-recipe --based-on sac", force=True)
def recipe_new(out: Out, name: NewNameArgument, based_on: BasedOnOption = "ppo", output: FolderOption = Path()) -> None:
    """Write a commented NAME.yaml with every key."""
    _write_new(out, "recipe", output / f"{name}.yaml", learning.load_recipe(based_on).new_text(name))


@recipe_group.add("schema", "recipe schema > recipe.schema.json")
def recipe_schema(out: Out) -> None:
    """Print the JSON Schema of recipe files.

    For editors that complete and check YAML.
    """
    out.print_json(learning.TrainingRecipe.json_schema())


def _show_file(out: Out, path: Path) -> None:
    from ethbrake_marl.files.yaml import SIZE_LIMIT

    out.show(read_plain(path, SIZE_LIMIT).decode("utf-8"), end="")


def _write_new(out: Out, kind: str, file: Path, text: str) -> None:
    out.write(file, text)
    out.note(f"written: {file}; change it, then: ethbrake {kind} validate {file}")


agent_group = app.group(
    "agent", "List who can drive, or hand a policy on.", "agent list", "agent export runs/early --onnx early.onnx"
)


@agent_group.add("list", "agent list", json=True)
def agent_list(out: Out) -> None:
    """List all agents: how each is written, what it does, what it knows.

    What begins with + goes behind any agent, for instance full_brake+step: +refined first, then one shield.
    """
    from ethbrake_marl.agents import Knowledge, agent_entries

    told, rows = [], []
    for entry in agent_entries():
        knows, added = Knowledge.of(entry), "also " if entry.form.startswith("+") else ""
        told.append({"agent": entry.form, "about": entry.about, "knows": list(knows), "omniscient": knows.sees_through})
        rows.append((entry.form, entry.about, f"{added}{knows.text}{' †' if knows.sees_through else ''}"))
    out.result(
        told,
        Sheet("", ("Agent", "Drives by", "Knows"), rows, gap=2),
        "† omniscient: reads what no channel brought. With :believed behind it, it decides on what was received.",
        "ladder stands for coast to best_harm; a typo gets a suggestion. See docs/baselines.md and docs/shield.md.",
    )


@agent_group.add("export", "agent export runs/early --onnx early.onnx", force=True)
def agent_export(
    out: Out,
    policy: Annotated[str, typer.Argument(metavar="FOLDER", help="A run, a policy bundle, or shipped/NAME.")],
    onnx: Annotated[Path, typer.Option(metavar="FILE", help="The ONNX model to write.")],
) -> None:
    """Write a policy as an ONNX model: observation in, acceleration out.

    Needs the package onnx, which the extra `export` brings.
    """
    from ethbrake_marl.policies import load_named_policy

    out.check(onnx)
    out.write(onnx, load_named_policy(policy).to_onnx(), what="written")
