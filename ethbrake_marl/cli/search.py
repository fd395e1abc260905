"""The commands ``search ...``: the profile of least harm in every world, and the worlds in which an agent is worst."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from ethbrake_marl.cli.command import command, new_group
from ethbrake_marl.cli.out import Out, plain_table
from ethbrake_marl.defaults import (
    EPISODES,
    HARM_COUNTS,
    HINDSIGHT,
    LIST_SEED,
    MEASURES,
    MOST_NAMED_WORLDS,
    SEARCH_BUDGET,
    HarmCount,
    MeasureName,
)
from ethbrake_marl.errors import InvalidInput, count_of

if TYPE_CHECKING:
    from ethbrake_marl.evaluation.inputs import NamedWorld, NamedWorlds
    from ethbrake_marl.limits.best_harm import BestHarmTable
    from ethbrake_marl.scenario import Sample, Scenario, Task
    from ethbrake_marl.studies.falsification import Falsified, Measure

ROUNDING = 1e-6  # m2/s2

search_group = new_group(
    "search",
    "Search for the profile of least harm in every world, or for the worlds in which an agent is worst.",
    "search best-harm --episodes 200 --budget 20000 --json",
    "search falsify --agent ppo@shipped --against e_v2x_bm --output worst.yaml",
)


@command(search_group, "best-harm", "search best-harm --episodes 200 --budget 20000 --json", json=True, force=True)
def best_harm_command(
    out: Out,
    scenario: str = "paper-random",
    episodes: int = EPISODES,
    seed: int = LIST_SEED,
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
    settings: list[str] | None = None,
) -> None:
    """Search every world for the profile of least harm.

    The other vehicles follow their scripts. With --output, finished parts are kept beside the file, and the same
    command goes on where it was interrupted.
    """
    from ethbrake_marl.evaluation.inputs import load_runnable, make_agents
    from ethbrake_marl.evaluation.measures import shipped_bounds, shipped_lines
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.limits.best_harm import fold_agent, load_table, save_table, search_list
    from ethbrake_marl.scenario import Task

    if shipped:
        found = list(shipped_bounds())
        out.result([bounds.to_json() for bounds in found], *shipped_lines(found))
        return
    out.check(output, ".npz", what="a table")
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
    parts = None if output is None else output.with_name(f".{output.name}.parts")
    if parts is not None:
        out.kept = f"{parts} keeps what was found; the same command goes on"
    table = search_list(
        chosen, sample, chunks=parts, counts=counts, vehicles=controlled, budget=budget, seed=search_seed,
        threads=threads, known=known, on_progress=lambda done, total: out.progress("best harm", done, total),
    )  # fmt: skip
    drivers = list(lineups[counts[0]])
    for k, name in enumerate(drivers):
        out.progress("agents", k, len(drivers))
        table = fold_agent(table, chosen, sample.worlds, name, {each: lineups[each][name] for each in counts})
    text = _spelled(
        "search best-harm", scenario=scenario, episodes=episodes, seed=seed, set=given.texts, harm_count=harm_count,
        vehicles=names and ",".join(names), budget=budget, search_seed=search_seed, start=start and start.name,
        agents=",".join(specs) or None, output="FILE.npz",
    )  # fmt: skip
    table = replace(table, header={**table.header, "episodes": episodes, "list_seed": seed, "command": text})
    if output is not None and parts is not None:
        save_table(output, table)
        shutil.rmtree(parts)
        out.note(f"every world: {output}")
    figures = _figures(chosen, sample, Task(chosen, controlled or chosen.learners), table, identity=out.as_json)
    lines = (
        f"{name:36} {value:.4f}" if isinstance(value, float) else f"{name:36} {value}"
        for name, value in figures.items()
    )
    out.result(figures, *lines)


def _agent_specs(agents: str | None, scenario: Scenario, controlled: Sequence[int] | None) -> list[str]:
    """Who drives after the search; ``InvalidInput`` if it is not the scenario's only learner that is searched."""
    if agents is None:
        return []
    if len(scenario.learners) != 1 or (controlled is not None and tuple(controlled) != scenario.learners):
        raise InvalidInput("--agents: drive the scenario's only learner; leave out --vehicles")
    return [spec.strip() for spec in agents.split(",")]


def _figures(
    scenario: Scenario, sample: Sample, task: Task, table: BestHarmTable, *, identity: bool
) -> dict[str, object]:
    """What was asked, the mean best known harm under each count (m2/s2), and what is proven beside it.

    ``identity``: of the worlds, too; those that were left out are in no hash.
    """
    import numpy as np

    from ethbrake_marl.evaluation.inputs import result_identity
    from ethbrake_marl.evaluation.measures import proven_of_table
    from ethbrake_marl.limits.best_harm import LEFT_OUT

    told: dict[str, object] = {key: value for key, value in table.header.items() if key != "after"}
    for harm_count, best in table.best.items():
        told["best_known_first_impact_harm" if harm_count == "first" else "best_known_total_harm"] = float(
            best.harm.mean()
        )
        told["harmless_rate"] = float((best.harm == 0.0).mean())
    proven = proven_of_table(sample.worlds, task, table)
    if proven is not None:
        told["proven_harm"] = proven.proven_harm
        if proven.contact_proven_rate is not None:
            told["contact_proven_rate"] = proven.contact_proven_rate
        told["impact_proven_rate"] = proven.impact_proven_rate
        inside = {} if proven.between is None else asdict(proven.between)
        told |= {f"between_{name}": value for name, value in inside.items() if value is not None}
    if identity:
        left_out = np.flatnonzero(np.isin(sample.index, [int(world) for world in table.header.get(LEFT_OUT, ())]))
        told |= result_identity("best-harm", scenario, sample, left_out.tolist())
    return told


def _spelled(name: str, **options: Any) -> str:
    """A command line: without options that are None or False; one that is a tuple stands several times."""
    words = ["ethbrake", *name.split()]
    for option, value in options.items():
        if value is not None and value is not False:
            values = value if isinstance(value, tuple) else (value,)
            for each in values:
                words += [f"--{option.replace('_', '-')}", *([] if each is True else [str(each)])]
    return shlex.join(words)


@command(
    search_group, "falsify", "search falsify --agent ppo@shipped --against e_v2x_bm --output worst.yaml",
    json=True, force=True, parts=True,
)  # fmt: skip
def falsify_command(
    out: Out,
    context: typer.Context,
    agent: Annotated[
        str | None, typer.Option(help="Who drives; any agent of `ethbrake evaluate`.", show_default="policy@shipped")
    ] = None,
    measure: Annotated[
        MeasureName,
        typer.Option(metavar="|".join(MEASURES), help="What is searched for: harm, regret, a difference, a bound."),
    ] = "regret",
    against: Annotated[
        str | None,
        typer.Option(metavar="AGENT", help="Whom regret or difference compares with.", show_default=HINDSIGHT),
    ] = None,
    scenario: str = "paper-random",
    budget: Annotated[int, typer.Option(help="Worlds that are tried.", min=1)] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0)] = 0,
    keep: Annotated[int, typer.Option(help="Worlds that are kept, at most.", min=1, max=MOST_NAMED_WORLDS)] = 20,
    at_random: Annotated[
        bool, typer.Option("--at-random", help="Try worlds as a list draws them, to compare the search with.")
    ] = False,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Write the worlds, by name, for evaluate and --again.")
    ] = None,
    again: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Drive the worlds of a file again instead of searching.")
    ] = None,
) -> None:
    """Search a scenario's ranges for the worlds in which an agent is worst.

    regret: what the agent does more than --against, by default the best profile found with hindsight. bound: how near
    a shield comes to the bound it told; above zero it is broken. difference: where two agents differ most. With
    --again FILE the kept worlds are driven again, by --agent or who drove then; exit status 1: one of them is worse.
    """
    from ethbrake_marl.evaluation.inputs import check_agents, load_evaluated, named_worlds_text, result_versions
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.studies.falsification import falsify, make_measure, named_worlds

    if again is not None:
        _refuse_others(context)
        _drive_again(out, again, agent)
        return
    agent = agent or "policy@shipped"
    out.check(output, ".yaml", ".yml", what="a file of worlds")
    given = read_settings(settings)
    chosen = load_evaluated(scenario, vehicle, given.scenario)
    measured_by = make_measure(measure, agent, against, chosen, harm_count)
    check_agents(measured_by.agents, chosen.replace(early_impacts="keep").sample(1, seed).worlds, chosen)
    found = falsify(
        measured_by, budget, seed, most=keep, adaptive=not at_random,
        on_round=lambda done, total: out.progress(agent, done, total),
    )  # fmt: skip
    worlds, told = named_worlds(found, measured_by), _told(found, budget)
    summary = _summary(told, measured_by)
    told |= {"worlds": [world.model_dump(exclude_none=True) for world in worlds]}
    if worlds:
        command = _spelled(
            "search falsify", agent=agent, measure=measure, against=against, scenario=scenario, budget=budget,
            seed=seed, keep=keep, at_random=at_random, vehicle=vehicle, harm_count=harm_count, set=given.texts,
        )  # fmt: skip
        kept = _kept(measured_by, worlds, scenario, agent, against, vehicle, given.texts, command)
        told |= kept.model_dump(exclude_none=True)
        if output is not None:
            out.write(output, named_worlds_text(kept), what="the worlds")
    elif output is not None:
        out.note(f"nothing was found, and {output} not written")
    out.result({**told, "versions": result_versions()}, *_table(worlds, measured_by), summary)


def _kept(
    measure: Measure, worlds: list[NamedWorld], scenario: str, agent: str, against: str | None, vehicle: str | None,
    texts: tuple[str, ...], found_by: str,
) -> NamedWorlds:  # fmt: skip
    """The file of these worlds; the scenario, agents and vehicle as they were asked for."""
    from ethbrake_marl.evaluation.inputs import FORMAT, VERSION, NamedWorlds, scenario_sha256

    return NamedWorlds(
        format=FORMAT,
        version=VERSION,
        scenario=scenario,
        scenario_sha256=scenario_sha256(measure.scenario),
        settings=[*texts, *([f"roles={{{vehicle}: learner}}"] if vehicle else [])],
        agent=agent,
        measure=measure.name,
        against=against,
        harm_count=measure.harm_count,
        found_by=found_by,
        worlds=worlds,
    )


def _refuse_others(context: typer.Context) -> None:
    """Refuse options that ``--again`` would ignore: the file says the rest."""
    for name in context.params.keys() - {"agent", "again", "as_json"}:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "--set" if name == "settings" else f"--{name.replace('_', '-')}"
            raise InvalidInput(f"--again: the file says what is measured; {option} has no place beside it, --agent has")


def _drive_again(out: Out, file: Path, agent: str | None) -> None:
    """Measure the worlds of a file once more, and compare; exit status 1 where one is worse, or could not be driven."""
    import numpy as np

    from ethbrake_marl.agents.registry import parse_spec
    from ethbrake_marl.evaluation.inputs import load_evaluated, read_named_worlds
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.scenario import Sample
    from ethbrake_marl.studies.falsification import make_measure

    kept = read_named_worlds(file)
    for spec in (*([kept.agent] if agent is None else []), *([kept.against] if kept.against else [])):
        if (code := parse_spec(spec).file) is not None:
            raise InvalidInput(
                f"{file}: names an agent that is code ({code[0]}), which is not run because a file names it; --agent"
                " names another one, and who is compared with is edited in the file"
            )
    chosen = load_evaluated(kept.scenario, None, read_settings(kept.settings).scenario)
    measured_by = make_measure(kept.measure, agent or kept.agent, kept.against, chosen, kept.harm_count)
    worlds = kept.worlds_of(chosen, str(file))
    measured = measured_by(Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0))
    rows = [
        {
            "name": world.name,
            "before": world.score,
            "now": float(now) if np.isfinite(now) else None,
            "worse": not np.isfinite(now) or bool(now > world.score + ROUNDING),
        }
        for world, now in zip(kept.worlds, measured.score, strict=True)
    ]
    table = plain_table("World", f"{kept.measure} before", "now", "", padding=(0, 1, 0, 0))
    for row in rows:
        now = "could not be driven" if row["now"] is None else f"{row['now']:.4f}"
        table.add_row(str(row["name"]), f"{row['before']:.4f}", now, "worse" if row["worse"] else "")
    out.result({"agent": agent or kept.agent, "measure": kept.measure, "worlds": rows}, table)
    worse = sum(bool(row["worse"]) for row in rows)
    out.note(f"{file}: {agent or kept.agent} is worse in {worse} of {count_of(len(rows), 'world')}")
    if worse:
        raise typer.Exit(1)


def _table(worlds: list[NamedWorld], measure: Measure) -> list[Table]:
    """The found worlds, where there are any."""
    beside = {"harm": None, "bound": "Bound"}.get(measure.name, "Reference's harm")
    titles = ("World", measure.name.capitalize(), "Harm", *([beside] if beside else []), "State")
    table = plain_table(*titles, padding=(0, 1, 0, 0))
    for world in worlds:
        state = ", ".join(f"{name} {value:.4g}" for name, value in world.state.items())
        reference = [] if world.reference is None else [f"{world.reference:.2f}"]
        table.add_row(world.name, f"{world.score:.4g}", f"{world.harm:.2f}", *reference, state)
    return [table] if worlds else []


def _told(found: Falsified, budget: int) -> dict[str, object]:
    """What all the tried worlds were like, as JSON."""
    import numpy as np

    from ethbrake_marl.studies.speed import this_machine

    good = found.scores[np.isfinite(found.scores)]
    return {
        "tried": budget,
        "counted": len(good),
        "share_above_zero": found.share_above,
        "first_above_zero": found.first_above,
        "median": float(np.median(good)),
        "worst": float(good.max()),
        "machine": asdict(this_machine()),
    }


def _summary(told: dict[str, Any], measure: Measure) -> str:
    budget, good, first = told["tried"], told["counted"], told["first_above_zero"]
    left_out = f" ({budget - good:,} of them are none of the scenario's)" if good < budget else ""
    what = f"{measure.name} in m2/s2, {measure.harm_count} count"
    above = f"above zero in {100 * told['share_above_zero']:.1f} % of those tried"
    return (
        f"{measure.scenario.name}: {budget:,} worlds tried{left_out}; {what}: worst {told['worst']:.4g}, median"
        f" {told['median']:.4g}; {above}, {f'the first after {first:,}' if first else 'none'}."
        " The search looks for bad worlds: shares of it say nothing about a list."
    )
