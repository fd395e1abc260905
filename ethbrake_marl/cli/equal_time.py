"""The command ``ethbrake equal-time``: parse, measure, print."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import JsonOption, ScenarioOption, SetOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, show, write_json
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, count_of

if TYPE_CHECKING or LATE:
    import numpy as np

    from ethbrake_marl.evaluation.identity import result_identity
    from ethbrake_marl.evaluation.inputs import check_agents, load_driven, make_lineup
    from ethbrake_marl.learning.settings import read_settings
    from ethbrake_marl.limits.shipped import best_known
    from ethbrake_marl.physics import Worlds
    from ethbrake_marl.scenario import Scenario, Task
    from ethbrake_marl.studies.equal_time import equal_time, timed_table

REFINED = "ppo@shipped+refined+episode"
SEARCHES = (  # without a policy, from a millisecond per world to what refining takes and more
    "best_harm:1000,best_harm:3000,best_harm:10000,best_harm:20000,best_harm:40000,"
    "planner:64,planner:256,planner:1024,planner:2048"
)
LIST_SEED = 8  # no shipped table holds the worlds of this list: best_harm has to search them


def equal_time_command(
    scenario: ScenarioOption = "paper-random",
    agents: Annotated[
        str, typer.Option(metavar="A,B,...", help="Who drives, with commas between them.")
    ] = f"e_v2x_bm,ppo@shipped,{REFINED},{SEARCHES}",
    against: Annotated[str, typer.Option(metavar="A", help="Whose harm the others' is compared with.")] = REFINED,
    episodes: Annotated[int, typer.Option(help="Worlds of the list.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the list; not one of which a table ships.")] = LIST_SEED,
    harm_count: Annotated[
        HarmCount, typer.Option(help="Harm that agents minimise: first impacts only, or all.")
    ] = "first",
    repeats: Annotated[int, typer.Option(help="How often each agent is timed; the median is told.")] = 3,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare agents at equal processor time: harm, and milliseconds per world.

    The agents are those of evaluate. best_harm:K is a plain search with K candidates at the alert, without a policy;
    planner:K searches anew at every decision.
    """
    chosen = load_driven(scenario, None, read_settings(settings).scenario)
    worlds = chosen.sample(episodes, seed)
    lineup = make_lineup(agents.split(","), chosen, harm_count=harm_count)
    check_agents(lineup, worlds.worlds, chosen)
    if any(spec.startswith("best_harm") for spec in lineup):
        _check_unknown(worlds.worlds, chosen, harm_count, seed)
    with interruptible("nothing was written"), progress_bars() as bars:
        rows = equal_time(
            worlds,
            lineup,
            scenario=chosen,
            against=against,
            harm_count=harm_count,
            repeats=repeats,
            on_progress=bars.show_progress,
        )
    machine = this_machine()
    if as_json:
        conditions = {
            "scenario": chosen.name,
            "seed": seed,
            "episodes": episodes,
            "harm_count": harm_count,
            "against": against,
            **result_identity("equal-time", chosen, worlds),
        }
        write_json({"machine": asdict(machine), **conditions, "agents": [row.to_json() for row in rows]})
        return
    result_console().print(timed_table(rows, against))
    show(f"{chosen.name}: {count_of(episodes, 'world')}, seed {seed}; {harm_count} harm minimised. Machine: {machine}")


def _check_unknown(worlds: Worlds, scenario: Scenario, harm_count: HarmCount, seed: int) -> None:
    """Refuse worlds of a shipped table: ``best_harm`` would look them up, and its time would be no search's."""
    kept = int(np.isfinite(best_known(worlds, Task(scenario, scenario.learners))[harm_count]).sum())
    if kept:
        raise InvalidInput(
            f"--seed {seed}: a shipped table holds {kept:,} of these {worlds.n:,} worlds, so best_harm would look them"
            " up instead of searching; give another seed"
        )
