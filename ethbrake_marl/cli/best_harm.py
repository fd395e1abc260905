"""The command ``ethbrake best-harm``: parse, search, print; the table it may write is resumable."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, JsonOption, ScenarioOption, SetOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, say, show, write_json
from ethbrake_marl.defaults import EPISODES, HARM_COUNTS, LIST_SEED, SEARCH_BUDGET, HarmCount
from ethbrake_marl.errors import InvalidInput

if TYPE_CHECKING or LATE:
    import numpy as np

    from ethbrake_marl.agents.protocol import Agent
    from ethbrake_marl.evaluation import check_target
    from ethbrake_marl.evaluation.inputs import load_runnable, make_agents, result_identity
    from ethbrake_marl.evaluation.measures import proven_of_table, shipped_bounds, shipped_lines
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.limits.best_harm import LEFT_OUT, BestHarmTable, fold_agent, load_table, save_table, search_list
    from ethbrake_marl.physics import Worlds
    from ethbrake_marl.scenario import Sample, Scenario, Task

TABLE_ENDING = ".npz"


def best_harm_command(
    scenario: ScenarioOption = "paper-random",
    episodes: Annotated[int, typer.Option(help="Worlds of the list.")] = EPISODES,
    seed: Annotated[int, typer.Option(help="Seed of the list.")] = LIST_SEED,
    harm_count: Annotated[
        HarmCount | None, typer.Option(help="Harm to minimise: first impacts only, or all.", show_default="both")
    ] = None,
    vehicles: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Who is controlled, together.", show_default="the learners"),
    ] = None,
    budget: Annotated[int, typer.Option(help="Candidate profiles per world and count.")] = SEARCH_BUDGET,
    search_seed: Annotated[int, typer.Option(help="Seed of the search.")] = 0,
    threads: Annotated[
        int | None, typer.Option(help="Worlds searched at once; changes no result.", show_default="every core")
    ] = None,
    start: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="A table to start from; no world gets worse than there.")
    ] = None,
    agents: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Who drives afterwards; where one does less harm, its episode counts."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="Also write the table of every world to this file.")
    ] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Instead: proven and best known harm of every shipped table, and the gap.")
    ] = False,
    settings: SetOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search every world for the profile of least harm.

    The other vehicles follow their scripts. With --output, finished parts are kept beside the file, and the same
    command goes on where it was interrupted.
    """
    if shipped:
        _show_shipped(as_json=as_json)
        return
    _check_output(output, force=force)
    given = read_settings(settings)
    chosen = load_runnable(scenario, given.scenario)
    names = None if vehicles is None else [name.strip() for name in vehicles.split(",")]
    controlled = None if names is None else chosen.with_learners(names).learners
    if controlled is None and not chosen.learners:
        raise InvalidInput(f"scenario {chosen.name!r} has no learner; say who is controlled: --vehicles vehicle_2")
    known = None if start is None else load_table(start)
    sample = chosen.sample(episodes, seed)
    counts: Sequence[HarmCount] = HARM_COUNTS if harm_count is None else (harm_count,)
    specs = _agent_specs(agents, chosen, controlled)
    lineups = {each: make_agents(specs, chosen, harm_count=each) for each in counts}
    drivers = {name: {each: lineups[each][name] for each in counts} for name in lineups[counts[0]]}
    parts = None if output is None else output.with_name(f".{output.name}.parts")
    table = _search(
        chosen, sample, parts, drivers, counts=counts, vehicles=controlled, budget=budget, seed=search_seed,
        threads=threads, known=known,
    )  # fmt: skip
    text = _command_text(scenario, given.texts, episodes, seed, harm_count, names, budget, search_seed, start, specs)
    table = replace(table, header={**table.header, "episodes": episodes, "list_seed": seed, "command": text})
    if output is not None and parts is not None:
        save_table(output, table)
        shutil.rmtree(parts)
        say(f"every world: {output}")
    figures = {**best_harm_figures(table), **_prove(sample.worlds, Task(chosen, controlled or chosen.learners), table)}
    _show(figures | (_identity(chosen, sample, table) if as_json else {}), as_json=as_json)


def _identity(scenario: Scenario, sample: Sample, table: BestHarmTable) -> dict[str, object]:
    """What the figures are about; worlds that were left out are in no hash."""
    left_out = np.flatnonzero(np.isin(sample.index, [int(world) for world in table.header.get(LEFT_OUT, ())]))
    return result_identity("best-harm", scenario, sample, left_out.tolist())


def _search(
    scenario: Scenario,
    sample: Sample,
    parts: Path | None,
    drivers: Mapping[str, Mapping[HarmCount, Agent]],
    **question: Any,
) -> BestHarmTable:
    """``search_list`` with a bar, keeping what was found in the folder ``parts``; then the agents drive."""
    kept = "nothing was written" if parts is None else f"{parts} keeps what was found; the same command goes on"
    with interruptible(kept), progress_bars() as bars:
        table = search_list(
            scenario,
            sample,
            chunks=parts,
            on_progress=lambda done, total: bars.show("best harm", done, total),
            **question,
        )
        for k, (spec, by_count) in enumerate(drivers.items()):
            bars.show("agents", k, len(drivers))
            table = fold_agent(table, scenario, sample.worlds, spec, by_count)
    return table


def _agent_specs(agents: str | None, scenario: Scenario, controlled: Sequence[int] | None) -> list[str]:
    """Who drives after the search; ``InvalidInput`` if it is not the scenario's only learner that is searched."""
    if agents is None:
        return []
    if len(scenario.learners) != 1 or (controlled is not None and tuple(controlled) != scenario.learners):
        raise InvalidInput("--agents: drive the scenario's only learner; leave out --vehicles")
    return [spec.strip() for spec in agents.split(",")]


def _check_output(output: Path | None, *, force: bool) -> None:
    """Refuse a table's file before any work."""
    if output is not None:
        check_target(output, force=force)
        if output.suffix != TABLE_ENDING:
            raise InvalidInput(f"{output}: a table ends in {TABLE_ENDING}")


def _show(figures: dict[str, object], *, as_json: bool) -> None:
    if as_json:
        write_json(figures)
        return
    for name, value in figures.items():
        show(f"{name:36} {value:.4f}" if isinstance(value, float) else f"{name:36} {value}")


def best_harm_figures(table: BestHarmTable) -> dict[str, object]:
    """What was asked, the mean best known harm under each count (m2/s2), and the share of worlds without any."""
    figures: dict[str, object] = {key: value for key, value in table.header.items() if key != "after"}
    for harm_count, best in table.best.items():
        name = "best_known_first_impact_harm" if harm_count == "first" else "best_known_total_harm"
        figures[name] = float(best.harm.mean())
        figures["harmless_rate"] = float((best.harm == 0.0).mean())
    return figures


def _command_text(
    scenario: str, settings: Sequence[str], episodes: int, seed: int, harm_count: HarmCount | None,
    vehicles: Sequence[str] | None, budget: int, search_seed: int, start: Path | None, agents: Sequence[str],
) -> str:  # fmt: skip
    """The command that makes the same table, for its header: every option that changes a result."""
    words = ["ethbrake", "best-harm", "--scenario", scenario, "--episodes", str(episodes), "--seed", str(seed)]
    words += [word for text in settings for word in ("--set", text)]
    words += [] if harm_count is None else ["--harm-count", harm_count]
    words += [] if vehicles is None else ["--vehicles", ",".join(vehicles)]
    words += ["--budget", str(budget), "--search-seed", str(search_seed)]
    words += [] if start is None else ["--start", start.name]
    words += ["--agents", ",".join(agents)] if agents else []
    return shlex.join([*words, "--output", "FILE.npz"])


def _prove(worlds: Worlds, task: Task, table: BestHarmTable) -> dict[str, object]:
    """What is proven beside what was found; see ``evaluation.bounds``."""
    found = proven_of_table(worlds, task, table)
    if found is None:
        return {}
    told: dict[str, object] = {"proven_harm": found.proven_harm}
    if found.contact_proven_rate is not None:
        told["contact_proven_rate"] = found.contact_proven_rate
    told["impact_proven_rate"] = found.impact_proven_rate
    inside = {} if found.between is None else asdict(found.between)
    return told | {f"between_{name}": value for name, value in inside.items() if value is not None}


def _show_shipped(*, as_json: bool) -> None:
    """Print the bounds of every shipped table."""
    found = list(shipped_bounds())
    if as_json:
        write_json([bounds.to_json() for bounds in found])
        return
    for line in shipped_lines(found):
        show(line)
