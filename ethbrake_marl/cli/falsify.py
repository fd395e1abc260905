"""The command ``ethbrake falsify``: parse, search or drive again, print, write what was found."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Table

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import ForceOption, JsonOption, ScenarioOption, SetOption, VehicleOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, show, write_json
from ethbrake_marl.defaults import HINDSIGHT, MEASURES, MOST_NAMED_WORLDS, HarmCount, MeasureName
from ethbrake_marl.errors import InvalidInput, count_of

if TYPE_CHECKING or LATE:
    import numpy as np

    from ethbrake_marl.agents.registry import parse_spec
    from ethbrake_marl.evaluation import check_target
    from ethbrake_marl.evaluation.inputs import (
        FORMAT,
        VERSION,
        NamedWorld,
        NamedWorlds,
        check_agents,
        load_evaluated,
        named_worlds_text,
        read_named_worlds,
        result_versions,
        scenario_sha256,
        states_of,
    )
    from ethbrake_marl.evaluation.results import write_output
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.physics import Floats
    from ethbrake_marl.scenario import Sample, Scenario
    from ethbrake_marl.studies.falsification import Falsified, Measure, falsify, make_measure

WORSE = 1  # exit status when a kept world is worse than it was
ROUNDING = 1e-6  # m2/s2


AgentOption = Annotated[
    str | None, typer.Option(help="Who drives; any agent of `ethbrake evaluate`.", show_default="policy@shipped")
]
MeasureOption = Annotated[
    MeasureName,
    typer.Option(metavar="|".join(MEASURES), help="What is searched for: harm, regret, a difference, a bound."),
]
AgainstOption = Annotated[
    str | None,
    typer.Option(metavar="AGENT", help="Whom regret or difference compares with.", show_default=HINDSIGHT),
]
AtRandomOption = Annotated[
    bool, typer.Option("--at-random", help="Try worlds as a list draws them, to compare the search with.")
]
WorldsOption = Annotated[
    Path | None, typer.Option(metavar="FILE.yaml", help="Write the worlds, by name, for evaluate and --again.")
]
AgainOption = Annotated[
    Path | None, typer.Option(metavar="FILE.yaml", help="Drive the worlds of a file again instead of searching.")
]


def falsify_command(
    context: typer.Context,
    agent: AgentOption = None,
    measure: MeasureOption = "regret",
    against: AgainstOption = None,
    scenario: ScenarioOption = "paper-random",
    budget: Annotated[int, typer.Option(help="Worlds that are tried.", min=1)] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0)] = 0,
    most: Annotated[
        int, typer.Option("--keep", help="Worlds that are kept, at most.", min=1, max=MOST_NAMED_WORLDS)
    ] = 20,
    at_random: AtRandomOption = False,
    harm_count: Annotated[HarmCount, typer.Option(help="Harm that is measured, and that agents minimise.")] = "first",
    vehicle: VehicleOption = None,
    settings: SetOption = None,
    output: WorldsOption = None,
    again: AgainOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search a scenario's ranges for the worlds in which an agent is worst.

    regret: what the agent does more than --against, by default the best profile found with hindsight. bound: how near
    a shield comes to the bound it told; above zero it is broken. difference: where two agents differ most. With
    --again FILE the kept worlds are driven again, by --agent or who drove then; exit status 1: one of them is worse.
    """
    if again is not None:
        _refuse_others(context)
        with interruptible("nothing was written"):
            worse = _drive_again(again, agent, as_json=as_json)
        if worse:
            raise typer.Exit(WORSE)
        return
    agent = agent or "policy@shipped"
    _check_output(output, force=force)
    given = read_settings(settings)
    chosen = load_evaluated(scenario, vehicle, given.scenario)
    measured_by = make_measure(measure, agent, against, chosen, harm_count)
    check_agents(measured_by.agents, chosen.replace(early_impacts="keep").sample(1, seed).worlds, chosen)
    with interruptible("nothing was written"), progress_bars() as bars:
        found = falsify(
            measured_by, budget, seed, most=most, adaptive=not at_random,
            on_round=lambda done, total: bars.show(agent, done, total),
        )  # fmt: skip
    worlds = _named(found, measured_by)
    told = _told(found, budget) | {"worlds": [world.model_dump(exclude_none=True) for world in worlds]}
    if worlds:
        kept = _kept({**context.params, "agent": agent}, chosen, worlds, given.texts)
        told |= kept.model_dump(exclude_none=True)
        if output is not None:
            write_output(output, named_worlds_text(kept).encode(), force=force)
            say(f"the worlds: {output}")
    elif output is not None:
        say(f"nothing was found, and {output} not written")
    if as_json:
        write_json({**told, "versions": result_versions()})
        return
    _show(worlds, measured_by)
    show(_summary(found, measured_by, budget))


def _check_output(output: Path | None, *, force: bool) -> None:
    """Refuse a file of worlds that cannot be written, before any work."""
    if output is not None:
        if output.suffix.lower() not in (".yaml", ".yml"):
            raise InvalidInput(f"{output}: must end in .yaml")
        check_target(output, force=force)


def _refuse_others(context: typer.Context) -> None:
    """Refuse options that ``--again`` would ignore: the file says the rest."""
    for name in context.params.keys() - {"agent", "again", "as_json"}:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "--keep" if name == "most" else f"--{name.replace('_', '-')}"
            raise InvalidInput(f"--again: the file says what is measured; {option} has no place beside it, --agent has")


def _drive_again(file: Path, agent: str | None, *, as_json: bool) -> int:
    """Measure the worlds of a file once more, and compare; how many are worse, or could not be driven."""
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
    if as_json:
        write_json({"agent": agent or kept.agent, "measure": kept.measure, "worlds": rows})
    else:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for name in ("World", f"{kept.measure} before", "now", ""):
            table.add_column(name, overflow="fold")
        for row in rows:
            now = "could not be driven" if row["now"] is None else f"{row['now']:.4f}"
            table.add_row(str(row["name"]), f"{row['before']:.4f}", now, "worse" if row["worse"] else "")
        result_console().print(table)
    worse = sum(bool(row["worse"]) for row in rows)
    say(f"{file}: {agent or kept.agent} is worse in {worse} of {count_of(len(rows), 'world')}")
    return worse


def _named(found: Falsified, measure: Measure) -> list[NamedWorld]:
    """The kept worlds, worst first."""
    if not found.sample.worlds.n:
        return []
    states, measured = states_of(found.sample.worlds, measure.scenario), found.measured
    beside: Floats | list[None] = [None] * len(states) if measured.reference is None else measured.reference
    return [
        NamedWorld(
            name=f"{measure.name}-{k + 1}",
            score=float(measured.score[k]),
            harm=float(measured.harm[k]),
            reference=None if beside[k] is None else float(beside[k]),  # type: ignore[arg-type]
            state=state,
        )
        for k, state in enumerate(states)
    ]


def _show(worlds: list[NamedWorld], measure: Measure) -> None:
    if not worlds:
        return
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    beside = {"harm": None, "bound": "Bound"}.get(measure.name, "Reference's harm")
    for title in ("World", measure.name.capitalize(), "Harm", *([beside] if beside else []), "State"):
        table.add_column(title, overflow="fold")
    for world in worlds:
        state = ", ".join(f"{name} {value:.4g}" for name, value in world.state.items())
        reference = [] if world.reference is None else [f"{world.reference:.2f}"]
        table.add_row(world.name, f"{world.score:.4g}", f"{world.harm:.2f}", *reference, state)
    result_console().print(table)


def _told(found: Falsified, budget: int) -> dict[str, object]:
    """What all the tried worlds were like, as JSON."""
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


def _summary(found: Falsified, measure: Measure, budget: int) -> str:
    good = found.scores[np.isfinite(found.scores)]
    left_out = f" ({budget - len(good):,} of them are none of the scenario's)" if len(good) < budget else ""
    first = f"the first after {found.first_above:,}" if found.first_above else "none"
    name, count = measure.name, measure.harm_count
    return (
        f"{measure.scenario.name}: {budget:,} worlds tried{left_out}; {name} in m2/s2, {count} count:"
        f" worst {good.max():.4g}, median {np.median(good):.4g}; above zero in {100 * found.share_above:.1f} % of"
        f" those tried, {first}. The search looks for bad worlds: shares of it say nothing about a list."
    )


def _kept(
    asked: Mapping[str, Any], scenario: Scenario, worlds: list[NamedWorld], texts: tuple[str, ...]
) -> NamedWorlds:
    """The file of these worlds; ``asked`` are the command's options, ``texts`` its settings."""
    vehicle = asked["vehicle"]
    return NamedWorlds(
        format=FORMAT,
        version=VERSION,
        scenario=asked["scenario"],
        scenario_sha256=scenario_sha256(scenario),
        settings=[*texts, *([f"roles={{{vehicle}: learner}}"] if vehicle else [])],
        agent=asked["agent"],
        measure=asked["measure"],
        against=asked["against"],
        harm_count=asked["harm_count"],
        found_by=_command(asked, texts),
        worlds=worlds,
    )


def _command(asked: Mapping[str, Any], texts: tuple[str, ...]) -> str:
    """The command that finds the same worlds."""
    words = ["ethbrake", "falsify", "--agent", asked["agent"], "--measure", asked["measure"]]
    words += [] if asked["against"] is None else ["--against", asked["against"]]
    words += ["--scenario", asked["scenario"], "--budget", str(asked["budget"]), "--seed", str(asked["seed"])]
    words += ["--keep", str(asked["most"]), *(["--at-random"] if asked["at_random"] else [])]
    words += [] if asked["vehicle"] is None else ["--vehicle", asked["vehicle"]]
    words += ["--harm-count", asked["harm_count"]] + [word for text in texts for word in ("--set", text)]
    return shlex.join(words)
