"""The command ``ethbrake evaluate``: parse, let the agents drive, print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.command_options import ForceOption, JsonOption, ScenarioOption, VehicleOption
from ethbrake_marl.evaluation import (
    Rescored,
    SummaryRow,
    check_target,
    declared_objectives,
    evaluate,
    horizon_note,
    rescored,
    rescored_table,
    rich_table,
    summarise,
    write_per_world_csv,
)
from ethbrake_marl.evaluation.three_tests import TESTS
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.lineup import (
    EPISODES,
    LIST_SEED,
    PROGRESS_EVERY,
    SHIELDS,
    check_agents,
    choose_worlds,
    load_evaluated,
    make_lineup,
)
from ethbrake_marl.shield.uncertainty import EXAMPLE, parse_uncertainty
from ethbrake_marl.terminal import interruptible, progress_bars, result_console, say, write_json


def evaluate_command(
    scenario: ScenarioOption = "paper-random",
    agents: Annotated[
        str, typer.Option(metavar="A,B,...", help="Who drives, with commas between them.")
    ] = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[int | None, typer.Option(help="Worlds of the list.", show_default=str(EPISODES))] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the list.", show_default=str(LIST_SEED))] = None,
    count: Annotated[HarmCount, typer.Option(help="Harm that agents minimise: first impacts only, or all.")] = "first",
    shield: Annotated[
        str, typer.Option(metavar="|".join(SHIELDS), help="Put around every learned agent that has none.")
    ] = "none",
    uncertainty: Annotated[
        str | None,
        typer.Option(metavar="QUANTITY=WIDTH,...", help=f"What the robust shield does not know, such as {EXAMPLE}."),
    ] = None,
    initial_states: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Your own worlds, one per row, instead of the list.")
    ] = None,
    vehicle: VehicleOption = None,
    per_world: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Also write one row per world and agent to this file.")
    ] = None,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Also tell the results under this objective; standard: under all usual ones. Repeatable.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    Agents: full_brake, coast, constant:A (deceleration in m/s2), copy_leader, gentlest_front, e_v2x_bm,
    e_v2x_bm:pairwise, planner, best_harm; ladder: all of these but constant; of a run: team@PATH; and of a run or a
    policy bundle: ppo@PATH, sac@PATH, rehearsed@PATH, hybrid@PATH, hybrid:pairwise@PATH, hybrid:rehearsed@PATH,
    step@PATH, step:rehearsed@PATH, robust@PATH, robust:rehearsed@PATH. PATH may be shipped.
    """
    if per_world is not None:
        check_target(per_world, force=force)
    chosen = load_evaluated(scenario, vehicle)
    objectives = declared_objectives(objective or (), chosen.vehicles)
    sample, list_seed = choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(agents.split(","), chosen, count=count, shield=shield, uncertainty=intervals)
    check_agents(lineup, sample.worlds, chosen)
    with interruptible("nothing was written"), progress_bars() as bars:
        evaluation = evaluate(
            sample,
            lineup,
            scenario=chosen,
            seed=list_seed,
            chunk=PROGRESS_EVERY,
            on_progress=lambda agent, done: bars.show(agent, done, sample.worlds.n),
        )
    if per_world is not None:
        write_per_world_csv(per_world, evaluation, objectives=objectives, force=force)
        say(f"every world: {per_world}")
    told = rescored(evaluation, objectives)
    rows = summarise(evaluation)
    show_rows(rows, as_json, told)
    moving = {row.agent: row.horizon_ends for row in rows if row.policy_share is not None}
    if note := horizon_note(moving, sample.worlds.n, chosen.horizon_s):
        say(note)
    if told and not as_json:
        result_console().print(rescored_table(told, count))


def show_rows(rows: Sequence[SummaryRow], as_json: bool, told: Sequence[Rescored] = ()) -> None:
    """The rows as a table, or as JSON with what was ``told`` under other objectives."""
    if not as_json:
        result_console().print(rich_table(rows))
        return
    found = [row.to_json() for row in rows]
    if told:
        found = [row | {"objectives": [t.to_json() for t in told if t.agent == row["agent"]]} for row in found]
    write_json(found)


def show_beside(beside: Mapping[str, Sequence[SummaryRow]]) -> None:
    """The rows of the other tests, each below what its test asks."""
    for test, rows in beside.items():
        result_console().print(f"\n{TESTS[test]}\n", highlight=False, markup=False)
        result_console().print(rich_table(rows))
