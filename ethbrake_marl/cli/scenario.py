"""The commands ``ethbrake scenario ...``: look at scenarios, check one, start a new one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption
from ethbrake_marl.cli.terminal import say, show, write_json
from ethbrake_marl.defaults import LIST_SEED

if TYPE_CHECKING or LATE:
    from ethbrake_marl.agents.protocol import Team
    from ethbrake_marl.agents.registry import make_single_agent
    from ethbrake_marl.agents.rollout import drive
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.files.store import read_plain
    from ethbrake_marl.files.yaml import SIZE_LIMIT
    from ethbrake_marl.scenario import (
        list_scenarios,
        load_scenario,
        new_scenario_text,
        scenario_json_schema,
        scenario_path,
    )
    from ethbrake_marl.scenario.fields import LEARNER, count_kinds, is_state_free
    from ethbrake_marl.scenario.schema import SHIPPED

CHECKED_DRAWS = 1000  # worlds that `scenario validate` draws

scenario_app = typer.Typer(
    rich_markup_mode=None,
    help="Look at scenarios, check one, or start a new one.",
    epilog="Example: ethbrake scenario show paper-random",
)


@scenario_app.command("list", epilog="Example: ethbrake scenario list")
def scenario_list(as_json: JsonOption = False) -> None:
    """List the scenarios that have a name: that and the title, and the folder of those that a plug-in registers."""
    entries = list_scenarios()
    if as_json:
        write_json([{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries])
        return
    width = max(len(entry.name) for entry in entries)
    for entry in entries:
        show(f"{entry.name:{width}}  {entry.title}{'' if entry.origin == SHIPPED else f'  (from {entry.origin})'}")


@scenario_app.command("show", epilog="Example: ethbrake scenario show paper-random")
def scenario_show(scenario: Annotated[str, typer.Argument(metavar="NAME|PATH")]) -> None:
    """Print the YAML of a scenario that is in order."""
    load_scenario(scenario)
    show(read_plain(scenario_path(scenario), SIZE_LIMIT).decode("utf-8"), end="")


@scenario_app.command("validate", epilog="Example: ethbrake scenario validate my-scenario.yaml")
def scenario_validate(path: Annotated[str, typer.Argument(metavar="PATH|NAME")], as_json: JsonOption = False) -> None:
    """Check a scenario: one line, OK or what is wrong; then what may not be meant."""
    scenario = load_runnable(path)
    sample = scenario.sample(CHECKED_DRAWS, LIST_SEED)
    names = [scenario.vehicle_names[i] for i in scenario.learners]
    deciding = [i for i in range(scenario.vehicles) if not is_state_free(scenario.scripts.get(i, LEARNER))]
    braking = Team.copies(make_single_agent("full_brake"), deciding)
    moving = int((~drive(sample.worlds, braking, scenario).at_rest).sum())
    late = int((sample.worlds.vehicles.latency_s[:, 0] > 0.0).sum())
    if as_json:
        told = {"name": scenario.name, "vehicles": scenario.vehicles, "learners": names, "worlds": CHECKED_DRAWS}
        write_json({**told, "rejected": sample.rejected, "moving_at_horizon": moving, "vehicle_1_late": late})
        return
    counts = f"{CHECKED_DRAWS:,} worlds drawn, {sample.rejected:,} more refused for an early impact"
    learners = ", ".join(names) or "none"
    show(f"OK  {scenario.name}: {scenario.vehicles} vehicles, learners: {learners}; {counts}{count_kinds(sample)}")
    if moving:
        show(
            f"note: at the horizon ({scenario.horizon_s:g} s) something still moves in {moving:,} of them, though"
            " whoever decides brakes fully; what comes after counts nowhere. A longer horizon_s sees more"
        )
    if late:
        show(f"note: Vehicle 1, whose braking is the alert, has a latency above 0 in {late:,} of them")


@scenario_app.command("new", epilog="Example: ethbrake scenario new my-scenario --based-on paper-distance")
def scenario_new(
    name: str,
    based_on: Annotated[str, typer.Option(metavar="NAME|PATH", help="Whose values to start from.")] = "paper-random",
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the new file.")] = Path(),
    force: ForceOption = False,
) -> None:
    """Write a commented NAME.yaml with every key."""
    file = output / f"{name}.yaml"
    write_output(file, new_scenario_text(name, based_on).encode(), force=force)
    say(f"written: {file}; change it, then: ethbrake scenario validate {file}")


@scenario_app.command("schema", epilog="Example: ethbrake scenario schema > scenario.schema.json")
def scenario_schema() -> None:
    """Print the JSON Schema of scenario files.

    For editors that complete and check YAML.
    """
    write_json(scenario_json_schema())
