"""The commands ``search ...``: the profile of least harm in every world, and the worlds in which an agent is worst."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from ethbrake_marl import evaluation, learning
from ethbrake_marl.cli.command import Out, app
from ethbrake_marl.defaults import DEFAULT, HARM_COUNTS, HarmCount, MeasureName
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.files.sheet import Sheet

ROUNDING = 1e-6  # m2/s2

search_group = app.group(
    "search",
    "Search for the least harm, or for an agent's worst worlds.",
    "search best-harm --episodes 200 --budget 20000 --json",
    "search falsify --agent ppo@shipped --against e_v2x_bm --output worst.yaml",
)


@search_group.add("best-harm", "search best-harm --episodes 200 --budget 20000 --json", json=True, force=True)
def best_harm_command(
    out: Out,
    scenario: str = "paper-random",
    episodes: int = DEFAULT.EPISODES,
    seed: int = DEFAULT.LIST_SEED,
    harm_count: Annotated[
        HarmCount | None, typer.Option(help="Harm to minimise: first impacts only, or all.", show_default="both")
    ] = None,
    vehicles: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Who is controlled, together.", show_default="the learners")
    ] = None,
    budget: Annotated[int, typer.Option(help="Candidate profiles per world and count.")] = DEFAULT.SEARCH_BUDGET,
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
    import numpy as np

    from ethbrake_marl.agents import split_specs
    from ethbrake_marl.limits import BestHarmTable, search_list
    from ethbrake_marl.scenario import Task

    if shipped:
        found, sheet = evaluation.shipped_bounds()
        out.result(found, *sheet.markdown().splitlines())
        return
    out.check(output, ".npz", what="a table")
    given = learning.read_settings(settings)
    chosen = evaluation.load_runnable(scenario, given.scenario)
    names = None if vehicles is None else [name.strip() for name in vehicles.split(",")]
    controlled = None if names is None else chosen.with_learners(names).learners
    if controlled is None and not chosen.learners:
        raise InvalidInput(f"scenario {chosen.name!r} has no learner; say who is controlled: --vehicles vehicle_2")
    known = None if start is None else BestHarmTable.load(start)
    sample = chosen.sample(episodes, seed)
    counts: Sequence[HarmCount] = HARM_COUNTS if harm_count is None else (harm_count,)
    specs = [] if agents is None else [spec.strip() for spec in split_specs(agents)]
    if specs and (len(chosen.learners) != 1 or controlled not in (None, chosen.learners)):
        raise InvalidInput("--agents: drive the scenario's only learner; leave out --vehicles")
    lineups = {each: evaluation.make_agents(specs, chosen, harm_count=each) for each in counts}
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
        table = table.folded(chosen, sample.worlds, name, {each: lineups[each][name] for each in counts})
    text = _spelled(
        "search best-harm", scenario=scenario, episodes=episodes, seed=seed, set=given.texts, harm_count=harm_count,
        vehicles=names and ",".join(names), budget=budget, search_seed=search_seed, start=start and start.name,
        agents=",".join(specs) or None, output="FILE.npz",
    )  # fmt: skip
    table = replace(table, header={**table.header, "episodes": episodes, "list_seed": seed, "command": text})
    if output is not None and parts is not None:
        table.save(output)
        shutil.rmtree(parts)
        out.note(f"every world: {output}")
    figures: dict[str, object] = {key: value for key, value in table.header.items() if key != "after"}
    for each, best in table.best.items():
        counted = "first_impact" if each == "first" else "total"
        figures[f"best_known_{counted}_harm"] = float(best.harm.mean())
        figures["harmless_rate"] = float((best.harm == 0.0).mean())
    proven = evaluation.proven_of_table(sample.worlds, Task(chosen, controlled or chosen.learners), table)
    if proven is not None:
        inside = {f"between_{name}": value for name, value in (proven.pop("between") or {}).items()}
        figures |= {name: value for name, value in {**proven, **inside}.items() if value is not None}
    if out.as_json:  # worlds that were left out are in no hash
        left_out = np.flatnonzero(np.isin(sample.index, [int(world) for world in table.left_out]))
        figures |= evaluation.result_identity("best-harm", chosen, sample, left_out.tolist())
    lines = (
        f"{name:36} {value:.4f}" if isinstance(value, float) else f"{name:36} {value}"
        for name, value in figures.items()
    )
    out.result(figures, *lines)


def _spelled(name: str, **options: Any) -> str:
    """A command line: without options that are None or False; one that is a tuple stands several times."""
    words = ["ethbrake", *name.split()]
    for option, value in options.items():
        if value is not None and value is not False:
            for each in value if isinstance(value, tuple) else (value,):
                words += [f"--{option.replace('_', '-')}", *([] if each is True else [str(each)])]
    return shlex.join(words)


@search_group.add("falsify", "search falsify --agent ppo@shipped --against e_v2x_bm --output worst.yaml",
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
        typer.Option(
            metavar="|".join(get_args(MeasureName)), help="What is searched for: harm, regret, a difference, a bound."
        ),
    ] = "regret",
    against: Annotated[
        str | None,
        typer.Option(metavar="AGENT", help="Whom regret or difference compares with.", show_default=DEFAULT.HINDSIGHT),
    ] = None,
    scenario: str = "paper-random",
    budget: Annotated[int, typer.Option(help="Worlds that are tried.", min=1)] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0)] = 0,
    keep: Annotated[
        int, typer.Option(help="Worlds that are kept, at most.", min=1, max=DEFAULT.MOST_NAMED_WORLDS)
    ] = 20,
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
    """Search for the worlds in which an agent is worst.

    It searches the ranges of a scenario. regret: what the agent does more than --against, by default the best profile
    found with hindsight. bound: how near a shield comes to the bound it told; above zero it is broken. difference:
    where two agents differ most. With --again FILE the kept worlds are driven again, by --agent or who drove then; exit
    status 1: one of them is worse.
    """
    import numpy as np

    from ethbrake_marl.studies.falsification import Measure
    from ethbrake_marl.studies.speed import this_machine

    if again is not None:
        for name in context.params.keys() - {"agent", "again", "as_json"}:
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = "set" if name == "settings" else name.replace("_", "-")
                raise InvalidInput(
                    f"--again: the file says what is measured; --{option} has no place beside it, --agent has"
                )
        _drive_again(out, again, agent)
        return
    agent = agent or "policy@shipped"
    out.check(output, ".yaml", ".yml", what="a file of worlds")
    given = learning.read_settings(settings)
    chosen = evaluation.load_runnable(scenario, given.scenario, vehicle=vehicle, drives="some")
    measured_by = Measure.of(measure, agent, against, chosen, harm_count)
    evaluation.check_agents(measured_by.agents, chosen.replace(early_impacts="keep").sample(1, seed).worlds, chosen)
    found = measured_by.falsify(
        budget, seed, most=keep, adaptive=not at_random,
        on_round=lambda done, total: out.progress(agent, done, total),
    )  # fmt: skip
    worlds, good = found.worlds, found.scores[np.isfinite(found.scores)]
    told: dict[str, Any] = {
        "tried": budget,
        "counted": len(good),
        "share_above_zero": found.share_above,
        "first_above_zero": found.first_above,
        "median": float(np.median(good)),
        "worst": float(good.max()),
        "machine": asdict(this_machine()),
        "worlds": [world.model_dump(exclude_none=True) for world in worlds],
    }
    first, shown = found.first_above, []
    left_out = f" ({budget - len(good):,} of them are none of the scenario's)" if len(good) < budget else ""
    summary = (
        f"{chosen.name}: {budget:,} worlds tried{left_out}; {measure} in m2/s2, {harm_count} count: worst"
        f" {told['worst']:.4g}, median {told['median']:.4g}; above zero in {100 * found.share_above:.1f} % of those"
        f" tried, {f'the first after {first:,}' if first else 'none'}."
        " The search looks for bad worlds: shares of it say nothing about a list."
    )
    if worlds:
        kept = evaluation.NamedWorlds.of(
            measured_by.scenario,
            scenario=scenario,
            settings=[*given.texts, *([f"roles={{{vehicle}: learner}}"] if vehicle else [])],
            agent=agent,
            measure=measure,
            against=against,
            harm_count=harm_count,
            found_by=_spelled(
                "search falsify", agent=agent, measure=measure, against=against, scenario=scenario, budget=budget,
                seed=seed, keep=keep, at_random=at_random, vehicle=vehicle, harm_count=harm_count, set=given.texts,
            ),
            worlds=worlds,
        )  # fmt: skip
        told |= kept.model_dump(exclude_none=True)
        beside = {"harm": [], "bound": ["Bound"]}.get(measure, ["Reference's harm"])
        columns = ("World", measure.capitalize(), "Harm", *beside, "State")
        rows = []
        for world in worlds:
            reference = [] if world.reference is None else [f"{world.reference:.2f}"]
            state = ", ".join(f"{name} {value:.4g}" for name, value in world.state.items())
            rows.append((world.name, f"{world.score:.4g}", f"{world.harm:.2f}", *reference, state))
        shown.append(Sheet("", columns, rows, gap=2))
        if output is not None:
            out.write(output, kept.text, what="the worlds")
    elif output is not None:
        out.note(f"nothing was found, and {output} not written")
    out.result({**told, "versions": evaluation.result_versions()}, *shown, summary)


def _drive_again(out: Out, file: Path, agent: str | None) -> None:
    """Measure the worlds of a file once more, and compare; exit status 1 where one is worse, or could not be driven."""
    import numpy as np

    from ethbrake_marl.agents import parse_spec
    from ethbrake_marl.scenario import Sample
    from ethbrake_marl.studies.falsification import Measure

    kept = evaluation.NamedWorlds.read(file)
    for spec in (*([kept.agent] if agent is None else []), *([kept.against] if kept.against else [])):
        if (code := parse_spec(spec).file) is not None:
            raise InvalidInput(
                f"{file}: names an agent that is code ({code[0]}), which is not run because a file names it; --agent"
                " names another one, and who is compared with is edited in the file"
            )
    chosen = evaluation.load_runnable(kept.scenario, learning.read_settings(kept.settings).scenario, drives="some")
    measured_by = Measure.of(kept.measure, agent or kept.agent, kept.against, chosen, kept.harm_count)
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
    shown = [
        (
            *(row["name"], f"{row['before']:.4f}"),
            "could not be driven" if row["now"] is None else f"{row['now']:.4f}",
            "worse" if row["worse"] else "",
        )
        for row in rows
    ]
    sheet = Sheet("", ("World", f"{kept.measure} before", "now", ""), shown, gap=2)
    out.result({"agent": agent or kept.agent, "measure": kept.measure, "worlds": rows}, sheet)
    worse = sum(bool(row["worse"]) for row in rows)
    out.note(f"{file}: {agent or kept.agent} is worse in {worse} of {count_of(len(rows), 'world')}")
    if worse:
        raise typer.Exit(1)
