"""The commands that measure and show: ``evaluate``, ``compare``, ``shield``, and ``watch ...``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ethbrake_marl import evaluation, learning, scenario as scenarios
from ethbrake_marl.cli.command import Out, app
from ethbrake_marl.defaults import DEFAULT, DatasetFormat, HarmCount
from ethbrake_marl.errors import InvalidInput, count_of, need
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.files.store import check_folder, write_output

if TYPE_CHECKING:
    from ethbrake_marl.agents import Driver
    from ethbrake_marl.physics import Bools, LeftOutRows
    from ethbrake_marl.scenario import Sample, Scenario, Task
    from ethbrake_marl.shield import Uncertainty

GROUP_EPISODES = 400  # of each scenario of a group; the tables of best known harm of `benchmark` hold them
HOSTED = 100  # worlds in somebody else's simulator
RESULTS, WORLDS, REPORT = "results.json", "worlds", "report.html"  # in the folder of an evaluation
_FILES = (RESULTS, f"{WORLDS}.csv", f"{WORLDS}.parquet", REPORT)
PAGES = (".html", ".htm")
_PROPOSERS = "ppo@shipped,full_brake,constant:3"
_HARMS = {"first_impact_harm": "First-impact harm", "total_harm": "Total harm", "harm": "Harm"}
_POLICIES = {"same": "the same", "other": "another", "none": ""}


def _asked_task(
    scenario: str,
    vehicle: str | None,
    settings: Sequence[str] | None,
    harm_count: HarmCount = "first",
    *,
    alone: bool = False,
) -> Task:
    """The scenario that is named, with its settings and with who is driven; ``alone``: that is one vehicle."""
    from ethbrake_marl.scenario import Task

    given = learning.read_settings(settings).scenario
    chosen = evaluation.load_runnable(scenario, given, vehicle=vehicle, drives="one" if alone else "some")
    return Task(chosen, chosen.learners, harm_count)


def _intervals(uncertainty: str | None) -> Uncertainty | None:
    """What the robust shield does not know."""
    from ethbrake_marl.shield import parse_uncertainty

    return None if uncertainty is None else parse_uncertainty(uncertainty)


def _make_drivers(
    agents: str | Sequence[str],
    scenario: Scenario,
    harm_count: HarmCount = "first",
    uncertainty: str | None = None,
    **how: bool,
) -> dict[str, Any]:
    """Who is named on the command line, as ``make_lineup`` makes them; tells which policies ``@shipped`` stands for."""
    intervals = _intervals(uncertainty)
    lineup = evaluation.make_lineup(agents, scenario, harm_count=harm_count, uncertainty=intervals, **how)
    _tell_shipped(lineup)
    return lineup


def _tell_shipped(lineup: Mapping[str, Driver]) -> None:
    for spec, driver in lineup.items():
        if "@shipped" in spec and (meant := getattr(driver, "name", spec)) != spec:
            Out().note(f"{spec} is {meant}")


@app.add(
    "evaluate", "evaluate --agents full_brake,constant:3.5,e_v2x_bm --episodes 1000", json=True, force=True, parts=True
)
def evaluate_command(
    out: Out,
    scenario: str = "paper-random",
    agents: str = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[
        int | None, typer.Option(help="Worlds of the list.", show_default=str(DEFAULT.EPISODES))
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the list.", show_default=str(DEFAULT.LIST_SEED))] = None,
    harm_count: HarmCount = "first",
    uncertainty: str | None = None,
    initial_states: Annotated[
        Path | None, typer.Option(metavar="CSV|YAML", help="Your own worlds: one per row, or named ones of falsify.")
    ] = None,
    vehicle: str | None = None,
    settings: list[str] | None = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also write the results to this folder: results.json.")
    ] = None,
    per_world: Annotated[
        Literal["csv", "parquet"] | None,
        typer.Option(help="Write one row per world and agent, too: worlds.csv or worlds.parquet."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Write a page with tables, figures and episodes, too: report.html.")
    ] = False,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Also tell the results under this objective; standard: under all usual ones. Repeatable.",
        ),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="Also tell the results by group: scenario (a mixture), vehicle_2_type."),
    ] = None,
    measures: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Also tell these: injury (by three curves), those of installed packages, my_file.py:measure.",
        ),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="sumo[:STEP_S]",
            help="Drive in that simulator, 100 worlds where no number is given, and tell the harm here beside it.",
        ),
    ] = None,
    jobs: int | None = None,
    ray: str | None = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Also print the rows of the paper's tables; on paper-random alone.")
    ] = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agent list` says who can drive; ladder stands for all of them from coast to best_harm. Behind any agent:
    +search, then one shield, +episode, +step or +robust; for instance full_brake+step or ppo@PATH+search+episode.
    PATH is a run or a policy bundle, or shipped.
    """
    from ethbrake_marl.agents import split_names, split_specs
    from ethbrake_marl.harm import declared_objectives

    _check_outputs(out, output, per_world, report=report)
    if group := scenarios.group_of_scenarios(scenario):
        other: dict[str, object] = {"--per-world": per_world, "--report": report, "--initial-states": initial_states}
        other |= {"--by": by, "--host": host, "--objective": objective, "--measures": measures, "--paper": paper}
        other |= {"--jobs": jobs, "--ray": ray}
        _refuse(other, f"{scenario} is a group of {len(group)} scenarios; give one of them")
        made = partial(_make_drivers, agents, harm_count=harm_count, uncertainty=uncertainty)
        tasks = [_asked_task(name, vehicle, settings, harm_count) for name in group]
        _evaluate_group(out, output, tasks, made, episodes, seed)
        return
    if host is not None:
        other = {"--report": report, "--measures": measures, "--paper": paper}
        _refuse(other, "tells of the physics here; leave it out, or --host")
        _refuse({"--jobs": jobs, "--ray": ray}, "a host drives in one process; leave it out, or --host")
        episodes = HOSTED if episodes is None and initial_states is None else episodes
    task = _asked_task(scenario, vehicle, settings)
    chosen = task.scenario
    told_too = tuple(split_names(measures)) if measures else ()
    lineup = evaluation.Lineup.of(
        split_specs(agents), chosen, harm_count=harm_count, uncertainty=uncertainty, measures=told_too
    )
    objectives = declared_objectives(objective or (), chosen.vehicles)
    _tell_shipped(lineup.make())
    used = {"harm_count": harm_count, "uncertainty": uncertainty}
    all_at_once = per_world or report or by or host or initial_states or paper
    if not all_at_once and (DEFAULT.EPISODES if episodes is None else episodes) > evaluation.HELD:
        summary, told = _evaluate_long_list(out, lineup, episodes or 0, seed, objectives, jobs, ray)
        results, shown = evaluation.results_to_json(summary, told=told, settings=used), [*summary.tables()]
    else:
        sample, drawn_by = evaluation.choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
        if by is not None:
            evaluation.Evaluation.check_group(sample.kinds, by)
        if paper:
            evaluation.check_papers_test(task, drawn_by)
        found, beside, sheets = _drive(out, host, sample, lineup, drawn_by, jobs, ray)
        used |= {"host": found.host} if found.host else {}
        summary, told = evaluation.summarise(found, paper=paper), found.rescore(objectives)
        groups = {} if by is None else evaluation.summarise_by(found, by)
        beside_it = _write_worlds(out, output, found, objectives, per_world)
        results = evaluation.results_to_json(summary, told=told, groups=groups, per_world=beside_it, settings=used)
        results = [row | beside.get(row["agent"], {}) for row in results]
        shown = [*summary.tables(), *_group_tables(groups), *sheets]
        if report and output is not None:
            output.mkdir(parents=True, exist_ok=True)
            _write_report(out, output / REPORT, found, summary, lineup.make(), harm_count)
    _write_results(out, output, results, f"{WORLDS}.{per_world}", REPORT if report else "")
    out.result(results, *shown, *([told.sheet(harm_count)] if told else []))
    _tell_horizon(out, _moving(summary), summary[0].episodes, chosen.horizon_s)


def _evaluate_long_list(
    out: Out, lineup: evaluation.Lineup, episodes: int, seed: int | None, objectives: Sequence[str],
    jobs: int | None, ray: str | None,
) -> tuple[evaluation.SummaryTable, evaluation.Rescores]:  # fmt: skip
    """The agents in a list of which no world is held in memory."""
    scenario, seed = lineup.scenario, DEFAULT.LIST_SEED if seed is None else seed
    evaluation.check_agents(lineup.make(), scenario.sample(1_000, seed).worlds, scenario, warn=True)
    tell = _tell_worlds(out, episodes)
    tally = evaluation.tally_list(lineup, episodes, seed, objectives=objectives, jobs=jobs, ray=ray, on_done=tell)
    return evaluation.summarise_tally(lineup, tally, seed), tally.rescore(objectives, scenario.vehicles)


def _tell_worlds(out: Out, worlds: int) -> Callable[[int], None]:
    def tell(done: int) -> None:
        out.progress("worlds", done, worlds)

    return tell


def _refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse the first of these options that is given."""
    for option in (name for name, value in options.items() if value):
        raise InvalidInput(f"{option}: {why}")


def _drive(
    out: Out, host: str | None, sample: Sample, lineup: evaluation.Lineup, seed: int | None, jobs: int | None,
    ray: str | None,
) -> tuple[evaluation.Evaluation, dict[str, Any], list[Any]]:  # fmt: skip
    """The agents in these worlds, and of a host by agent and as a table what it and the physics here do otherwise."""
    agents, scenario = lineup.make(), lineup.scenario
    evaluation.check_agents(agents, sample.worlds, scenario, warn=host is None)
    if host is None:
        tell_worlds = _tell_worlds(out, sample.worlds.n)
        return evaluation.evaluate_held(lineup, sample, seed, jobs=jobs, ray=ray, on_done=tell_worlds), {}, []
    from ethbrake_marl.hosts import find_host

    def tell(agent: str, done: int) -> None:
        out.progress(agent, done, sample.worlds.n)

    hosted = find_host(host)
    found, distrusted = hosted.evaluate(sample, agents, scenario, seed, on_progress=tell)
    here = evaluation.evaluate(sample, agents, scenario=scenario, seed=seed, aftermath=False)
    told, sheet = _beside_ours(hosted.name, found, here, distrusted, lineup.harm_count)
    return found, told, ["", sheet]


def _beside_ours(
    host: str, found: evaluation.Evaluation, here: evaluation.Evaluation, distrusted: Mapping[str, Bools | None],
    harm_count: HarmCount,
) -> tuple[dict[str, Any], Sheet]:  # fmt: skip
    """By agent, and as a table: the harm in a host and here, and what a shield promised there."""
    told: dict[str, Any] = {}
    rows: list[Any] = []
    for agent, outcome in found.outcomes.items():
        ours, theirs = (each.world_harm(harm_count) for each in (here.outcome(agent), outcome))
        difference, bound = evaluation.paired_difference(theirs, ours), outcome.predicted_harm
        about = {"host": host, "harm_here": float(ours.mean()), "difference": difference.value}
        if bound is not None and outcome.chosen_policy is not None:
            about["above_bound"] = int((theirs > bound).sum())
        if (shown := distrusted[agent]) is not None:
            about["distrusted"] = int(shown.sum())
        last = (str(about.get(name, "")) for name in ("above_bound", "distrusted"))
        told[agent] = {"beside": about}
        rows.append((agent, f"{ours.mean():.2f}", f"{theirs.mean():.2f}", difference, *last))
    columns: list[Column | str] = ["Agent", *map(Column, ("Here", "There", "Difference", "Above bound", "Distrusted"))]
    note = (
        f"There: {host}. {_HARMS['first_impact_harm' if harm_count == 'first' else 'total_harm']}, mean per world in"
        " m²/s², and the difference world by world with its 95 % interval. Above bound: worlds with more than a shield"
        " told at the alert. Distrusted: worlds in which the host did what the shield did not foretell; its bound"
        " promises nothing there. Modes step and robust alone compare."
    )
    return told, Sheet("", columns, rows, note)


def _group_tables(groups: Mapping[str, evaluation.SummaryTable]) -> list[Any]:
    tables: list[Any] = []
    for name, of_group in groups.items():
        tables += [f"\n{name}: {count_of(of_group[0].episodes, 'world')}\n", of_group.terminal()]
    return tables


def _evaluate_group(
    out: Out, output: Path | None, group: Sequence[Task], made: Callable[[Scenario], dict[str, Any]],
    episodes: int | None, seed: int | None,
) -> None:  # fmt: skip
    """Each agent in each scenario: whether anybody collides, how hard the hardest pair does, and what is left to do."""
    told: list[dict[str, Any]] = []
    rows: list[Any] = []
    for task in group:
        chosen = task.scenario
        sample, drawn_by = evaluation.choose_worlds(
            chosen, episodes=GROUP_EPISODES if episodes is None else episodes, seed=seed
        )
        lineup = made(chosen)
        evaluation.check_agents(lineup, sample.worlds, chosen)
        found = evaluation.evaluate(sample, lineup, scenario=chosen, seed=drawn_by)
        rows.append(chosen.name)
        for row in evaluation.summarise(found):
            outcome, share = found.outcome(row.agent), row[f"share_of_possible_reduction_{task.harm_count}"]
            hardest = 3.6 * math.sqrt(outcome.ledger.pair_harm("first").max(initial=0.0))
            each: dict[str, Any] = {
                "passed": not outcome.collided.any(),
                "collision_rate": float(outcome.collided.mean()),
                "hardest_impact_kmh": hardest,
                "first_impact_harm": float(outcome.first_impact_harm.mean()),
                "total_harm": float(outcome.total_harm.mean()),
            }
            shown = f"{each['collision_rate']:.1%}", f"{hardest:.1f}", *(f"{each[key]:.2f}" for key in list(each)[3:])
            rows.append((row.agent, "passed" if each["passed"] else "failed", *shown, share))
            each["share_of_possible_reduction"] = None if share is None else share.to_json()
            told.append({"scenario": chosen.name, "agent": row.agent, "worlds": found.worlds.n, **each})
    columns: list[Column | str] = [
        "Agent",
        "Result",
        Column("Collisions"),
        Column("Hardest, km/h", short="Hardest,\nkm/h"),
        Column("First-impact harm", short="First-impact\nharm"),
        Column("Total harm", short="Total\nharm"),
        Column(
            "Share of the possible reduction",
            digits=1,
            scale=100.0,
            unit=" %",
            short="Share of\npossible",
            interval="hidden",
        ),
    ]
    counted = "first-impact" if group[0].harm_count == "first" else "total"
    note = (
        f"{found.worlds.n:,} worlds of each, seed {drawn_by}; `ethbrake scenario explain` tells their parameters."
        " Passed: nobody collides, in no world. Harms: means per world in m²/s². Hardest: the closing speed of a pair."
        f" Share of the possible reduction of {counted} harm: 0 % for full braking,"
        " 100 % for the best known harm; none where that is not known of every world."
    )
    _write_results(out, output, told)
    out.result(told, Sheet("", columns, rows, note))


def _check_outputs(out: Out, output: Path | None, per_world: str | None, *, report: bool) -> None:
    """Refuse, before any work, a folder that cannot be written to, or that holds other results."""
    if output is None:
        _refuse({"--per-world": per_world, "--report": report}, "needs a folder for it: --output FOLDER")
        return
    if per_world == "parquet":
        need("pyarrow")
    check_folder(output, _FILES, force=out.force)


def _write_worlds(
    out: Out, output: Path | None, found: evaluation.Evaluation, objectives: Sequence[str], per_world: str | None
) -> Path | None:
    """The file with one row per world and agent, where it is asked for."""
    if output is None or per_world is None:
        return None
    file = output / f"{WORLDS}.{per_world}"
    output.mkdir(parents=True, exist_ok=True)
    evaluation.write_per_world(file, found, objectives=objectives, force=out.force)
    out.note(f"every world: {file}")
    return file


def _write_results(out: Out, output: Path | None, results: object, *beside: str) -> None:
    """``results.json``, with the files ``beside`` it; those of earlier results go."""
    if output is None:
        return
    output.mkdir(parents=True, exist_ok=True)
    for name in {*_FILES} - {RESULTS, *beside}:
        (output / name).unlink(missing_ok=True)
    write_output(output / RESULTS, _json_text(results).encode(), force=out.force)
    out.note(f"results: {output / RESULTS}")


def _json_text(content: object) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _tell_horizon(out: Out, moving: Mapping[str, int], worlds: int, horizon_s: float) -> None:
    """Say of shielded drivers in how many worlds, by driver, something still ``moving`` was cut off, if in any."""
    found = ", ".join(f"{name} {count}" for name, count in moving.items() if count)
    if found:
        out.note(
            f"note: bounds of the shield end at the horizon ({horizon_s:g} s) and say nothing of what comes after;"
            f" worlds, of {worlds}, that were not at rest then: {found}"
        )


def _moving(rows: Sequence[evaluation.SummaryRow]) -> dict[str, int]:
    """In how many worlds something still moves at the horizon, by shielded driver."""
    return {row.agent: row.horizon_ends for row in rows if row.policy_share is not None}


def _write_report(
    out: Out,
    path: Path,
    found: evaluation.Evaluation,
    rows: Sequence[evaluation.SummaryRow],
    agents: Mapping[str, Driver],
    harm_count: HarmCount,
) -> None:
    """Write the page of an evaluation that has just been made."""
    # matplotlib takes a second to load, and most evaluations draw nothing
    from ethbrake_marl.pages.report import Report

    done: list[str] = []

    def tell(agent: str) -> None:
        done.append(agent)
        out.progress("report: episodes", len(done), len(agents))

    scenario, names, asked = found.scenario, ", ".join(row.agent for row in rows), rows[0].parameters
    scripts = ", ".join(f"{vehicle} by {script}" for vehicle, script in asked["scripts"].items())
    report = Report(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(rows)} agents compared",
        rows,
        found,
        harm_count=harm_count,
        summary=scenario.title or "Agents on the same worlds.",
        settings={
            "Command": "ethbrake " + " ".join(sys.argv[1:]),
            "Agents": names,
            "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
            "Worlds": asked.line,
            "Driven by the agents": asked.get("controlled_vehicle") or ", ".join(asked["controlled_vehicles"]),
            "Driven by scripts": scripts or "none",
            "Time step, horizon": f"{asked['time_step_s']:g} s, {asked['horizon_s']:g} s",
        },
        versions=rows[0].versions,
    )
    report.driven(agents, on_agent=tell).write(path, force=out.force)
    out.note(f"report: {path}")


_FILE = typer.Argument(metavar="RESULTS.json", help="Results of evaluate, shield (--json) or run.")


@app.add("compare", "compare before/results.json after/results.json", json=True)
def compare_command(out: Out, first: Annotated[Path, _FILE], second: Annotated[Path, _FILE]) -> None:
    """Tell the difference of harm between two results.

    The second minus the first, for agents of the same name. Both must be of one command, and about the same worlds of
    the same scenario. Intervals are paired by world where the files of --per-world lie beside both results.
    """
    found = evaluation.compare_results(evaluation.read_result(first), evaluation.read_result(second))
    names = [_HARMS[name] for name in found.differences[0].harms]
    rows = [[each.marked, _POLICIES[each.policy], *each.harms.values()] for each in found.differences]
    out.result(found.to_json(), Sheet("", ["Agent", Column("Policy", text=True), *map(Column, names)], rows))
    out.note("second minus first, mean per world in m²/s²; in brackets: 95 % intervals,")
    why = found.unpaired_because
    out.note("paired by world" if why is None else f"NOT paired, wider than they would be paired by world: {why}")
    if found.exploits_line:
        out.note(found.exploits_line)
    for which, agents in zip(("first", "second"), found.left_over, strict=True):
        if agents:
            out.note(f"in the {which} only: {', '.join(agents)}")
    for name, (one, other) in {**found.other_settings, **found.other_versions}.items():
        out.note(f"note: {name} {one} in the first, {other} in the second")


@app.add("shield", "shield --agents ppo@shipped,full_brake --episodes 500", json=True)
def shield_command(
    out: Out,
    agents: str = _PROPOSERS,
    scenario: str = "paper-random",
    episodes: int = 2_000,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Compare agents without and behind the shield.

    No shield, episode mode and step mode, on the same worlds. The agents propose, without a shield of their own, and
    --harm-count is the harm that is guaranteed. Where several vehicles learn: no shield, step mode, and step mode with
    caps, for the whole team. Each decision that step mode replaced is simulated again without it: needed (harm would
    have been higher), harmless (the same), costly (lower).
    """
    task = _asked_task(scenario, vehicle, settings, harm_count)
    sample = task.scenario.sample(episodes, DEFAULT.LIST_SEED)
    rows = _measure_modes(out, agents, sample, task)
    out.result(rows.to_json(sample, task), *rows.sheets())
    _tell_left_out(out, rows[0].left_out, episodes)
    moving = {f"{row.agent} ({row.mode})": row.horizon_ends for row in rows if row.mode != "none"}
    _tell_horizon(out, moving, episodes - len(rows[0].left_out), task.scenario.horizon_s)


def _measure_modes(out: Out, agents: str, sample: Sample, task: Task) -> evaluation.ShieldModes:
    """The rows of these agents, with progress on stderr."""
    lineup = _make_drivers(agents, task.scenario, task.harm_count, bare=True)
    n = sample.worlds.n
    return evaluation.compare_modes(
        lineup, sample.worlds, task, on_progress=lambda name, done: out.progress(name, done, n)
    )


def _tell_left_out(out: Out, left_out: LeftOutRows, whole: int) -> None:
    """Name the worlds that count in no figure, of ``whole``, in a line on stderr; none where every world counts."""
    if left_out:
        told = [f"world {world} of seed {DEFAULT.LIST_SEED} ({reason})" for world, reason in left_out]
        out.note(evaluation.LeftOut.line(told, whole))


# The commands ``watch ...``: films, pictures, and what was seen as a dataset.

watch_group = app.group(
    "watch",
    "See and keep episodes: films, pictures, data.",
    "watch record --agents full_brake,e_v2x_bm --world 3 --output both.gif",
    "watch picture deceleration --world 5 --output curve.png",
)


@watch_group.add("record", "watch record --agents full_brake,e_v2x_bm --world 3 --output both.gif", force=True)
def record_command(
    out: Out,
    output: Annotated[Path, typer.Option(metavar="FILE.gif|FILE.mp4|FILE.svg", help="The film to write.")],
    agents: str = "e_v2x_bm",
    scenario: str = "paper-random",
    world: int = 0,
    seed: int = DEFAULT.LIST_SEED,
    vehicle: str | None = None,
    uncertainty: str | None = None,
) -> None:
    """Film agents in one world, in real time.

    It shows the road to scale, commands, impacts and harm.
    """
    out.check(output)
    evaluation.check_film(output.suffix.lower())
    chosen = _asked_task(scenario, vehicle, None).scenario
    lineup = _make_drivers(agents, chosen, uncertainty=uncertainty)
    worlds = chosen.sample(1, seed, first=world).worlds
    titled = {f"{name}: world {world} of {chosen.name}": agent for name, agent in lineup.items()}
    out.write(output, evaluation.film(worlds, titled, output.suffix.lower(), scenario=chosen), what="film")


@watch_group.add("dataset", "watch dataset --agents best_harm --episodes 1000 --output best.parquet", force=True)
def dataset_command(
    out: Out,
    output: Annotated[Path, typer.Option(metavar="FILE.parquet|NAME-v0", help="The dataset to write.")],
    agents: str = "best_harm",
    scenario: str = "paper-random",
    episodes: int = 1_000,
    seed: int = DEFAULT.LIST_SEED,
    format: Annotated[
        DatasetFormat | None, typer.Option(help="Of the dataset.", show_default="as the name of --output says")
    ] = None,
    vehicle: str | None = None,
    harm_count: HarmCount = "first",
    uncertainty: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Record what agents see, do and are rewarded with.

    Decision by decision, as one Parquet file of any agents and learners, or as a dataset of Minari of one learner. The
    recorded actions replay to the same bits. The reward counts the harm of --harm-count, too.
    """
    chosen = _asked_task(scenario, vehicle, settings, harm_count).scenario
    evaluation.check_dataset(output, chosen, format, force=out.force)
    lineup = _make_drivers(agents, chosen, harm_count, uncertainty)
    evaluation.check_agents(lineup, chosen.sample(1, seed).worlds, chosen)
    summary = evaluation.write_dataset(
        output,
        lineup,
        scenario=chosen,
        episodes=episodes,
        seed=seed,
        format=format,
        reward="harm" if harm_count == "first" else "total-harm",
        force=out.force,
        on_progress=lambda agent, done: out.progress(agent, done, episodes),
    )
    for agent, number in summary.episodes.items():
        change = f"harm differs from `ethbrake evaluate` by at most {summary.off_by[agent]:.2g} m2/s2 in a world"
        out.note(f"{agent}: {count_of(number, 'episode')}; {change}")
    for left in summary.left_out:
        out.note(f"left out: world {left.world} with {left.agent}: {left.reason}")
    out.note(f"dataset: {summary.path}, {count_of(summary.decisions, 'decision')}")
    if summary.format == "minari":
        folder = summary.path.resolve().parent
        out.note(f"load it: MINARI_DATASETS_PATH={folder}, minari.load_dataset({summary.path.name!r})")


picture_group = watch_group.group(
    "picture",
    "Draw one world, or the shield's work.",
    "watch picture deceleration --world 5 --output curve.png",
    "watch picture shield --episodes 500 --output shield.png",
)
PictureOption = Annotated[Path, typer.Option(metavar="FILE", help="The picture to write: .png, .svg or .pdf.")]


def _figures(out: Out, output: Path) -> ModuleType:
    """What draws (matplotlib takes a second to load); refuses a picture that cannot be written, before any work."""
    from ethbrake_marl import figures

    figures.picture_ending(output)
    out.check(output)
    return figures


def _write_picture(out: Out, output: Path, figure: Any, left_out: LeftOutRows = (), whole: int = 0) -> None:
    """Write a picture; ``left_out`` of ``whole`` worlds count in none of its figures."""
    from ethbrake_marl.figures import write_picture

    write_picture(output, figure, force=out.force)
    _tell_left_out(out, left_out, whole)
    out.note(f"picture: {output}")


def _caption(scenario: Scenario, episodes: int, rest: str, left_out: LeftOutRows) -> str:
    """What a picture of a list is about, and how many of its worlds count in no figure."""
    told = f"{scenario.name}, {count_of(episodes, 'world')} of the list of seed {DEFAULT.LIST_SEED}{rest}"
    return told + (f" Left out: {len(left_out):,}, which the physics could not advance." if left_out else "")


@picture_group.add(
    "deceleration", "watch picture deceleration --scenario paper-scenario-1 --world 0 --output curve.png", force=True,
)  # fmt: skip
def picture_deceleration(
    out: Out,
    output: PictureOption,
    scenario: str = "paper-scenario-1",
    world: int = 0,
    seed: int = DEFAULT.LIST_SEED,
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """Harm of one world by constant deceleration.

    Predicted and realised, of one vehicle, and the best known.
    """
    figures = _figures(out, output)
    task = _asked_task(scenario, vehicle, settings, alone=True)
    curve = evaluation.deceleration_curve(task.scenario.sample(1, seed, first=world).worlds, task)
    title = f"{task.scenario.name}, world {world} of the list of seed {seed}"
    _write_picture(out, output, figures.deceleration_figure(curve, title=title))


@picture_group.add("shield", "watch picture shield --agents ppo@shipped,full_brake --output shield.png", force=True)
def picture_shield(
    out: Out,
    output: PictureOption,
    agents: str = "full_brake,constant:3",
    scenario: str = "paper-random",
    episodes: int = 500,
    harm_count: HarmCount = "first",
    vehicle: str | None = None,
    settings: list[str] | None = None,
) -> None:
    """How often the shield intervenes, and what remains.

    From no allowance of harm to any. The agents propose, and --harm-count is the harm that is guaranteed.
    """
    from ethbrake_marl.shield import operating_curves

    figures = _figures(out, output)
    task = _asked_task(scenario, vehicle, settings, harm_count)
    worlds = task.scenario.sample(episodes, DEFAULT.LIST_SEED).worlds
    lineup = _make_drivers(agents, task.scenario, harm_count, bare=True)
    curves = operating_curves(worlds, lineup, task, on_progress=lambda name: out.progress(name, episodes, episodes))
    left_out = next(iter(curves.values()))[0].left_out
    rest = f"; step shield, {harm_count} harm. Beside the points: what certificates may reach above the bound (m²/s²)."
    figure = figures.operating_figure(list(curves.items()), caption=_caption(task.scenario, episodes, rest, left_out))
    _write_picture(out, output, figure, left_out, episodes)
