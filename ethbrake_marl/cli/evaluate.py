"""The commands that measure and show: ``evaluate``, ``compare``, ``shield``, and ``watch ...``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ethbrake_marl import evaluation, learning, scenario as scenarios
from ethbrake_marl.cli.command import Out, app, whole_number
from ethbrake_marl.defaults import DEFAULT, DatasetFormat, HarmCount
from ethbrake_marl.errors import InvalidInput, count_of, need
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.files.store import write_file

if TYPE_CHECKING:
    from ethbrake_marl.agents import Driver
    from ethbrake_marl.physics import Bools, LeftOutRows
    from ethbrake_marl.scenario import Sample, Scenario, Task
    from ethbrake_marl.shield import Uncertainty

GROUP_EPISODES = 400  # of each scenario of a group; the tables of best known harm of `benchmark` hold them
HOSTED = 100  # worlds in somebody else's simulator
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
    for spec, driver in lineup.items():
        if "@shipped" in spec and (meant := getattr(driver, "name", spec)) != spec:
            Out().note(f"{spec} is {meant}")
    return lineup


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
    per_world: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write one row per world and agent (.csv, .parquet), and FILE.json."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Also write a page with tables, figures and episodes to watch."),
    ] = None,
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
        Literal["injury"] | None, typer.Option(help="Also tell injuries, by three curves from the literature.")
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="sumo[:STEP_S]",
            help="Drive in that simulator, 100 worlds where no number is given, and tell the harm here beside it.",
        ),
    ] = None,
    shards: Annotated[
        int | None,
        typer.Option(
            metavar="K",
            help="Evaluate the list in K parts, in flat memory; changes no figure.",
            callback=whole_number(1),
        ),
    ] = None,
    jobs: Annotated[
        int,
        typer.Option(metavar="N", help="With --shards: processes; changes no figure.", callback=whole_number(1, 256)),
    ] = 1,
    ray: Annotated[
        str | None,
        typer.Option(metavar="local|ADDRESS", help="With --shards: on Ray, on all its cores or on --jobs of them."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="With --shards: keeps finished ones; the same command goes on."),
    ] = None,
    rows: Annotated[
        bool, typer.Option("--rows", help="With --output: also one row per world and agent, as Parquet files in it.")
    ] = False,
    paper: Annotated[
        bool, typer.Option("--paper", help="Also print the rows of the paper's tables; on paper-random alone.")
    ] = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agent list` says who can drive; ladder stands for all of them from coast to best_harm. Behind any agent:
    +search, then one shield, +episode, +step or +robust; for instance full_brake+step or ppo@PATH+search+episode.
    PATH is a run or a policy bundle, or shipped.
    """
    from ethbrake_marl.harm import declared_objectives

    whole: dict[str, object] = {"--per-world": per_world, "--report": report, "--initial-states": initial_states}
    whole |= {"--by": by, "--host": host}
    _check_shards(shards, jobs, ray, output, rows, measures, whole)
    _check_outputs(out, per_world, report)
    made = partial(_make_drivers, agents, harm_count=harm_count, uncertainty=uncertainty)
    if group := scenarios.group_of_scenarios(scenario):
        other = whole | {
            "--paper": paper,
            "--objective": objective,
            "--measures": measures,
            "--shards": shards,
            "--output": output,
        }
        _refuse(other, f"{scenario} is a group of {len(group)} scenarios; give one of them")
        tasks = [_asked_task(name, vehicle, settings, harm_count) for name in group]
        _evaluate_group(out, tasks, made, episodes, seed)
        return
    if host is not None:
        _refuse(
            {"--report": report, "--measures": measures, "--paper": paper},
            "tells of the physics here; leave it out, or --host",
        )
        episodes = HOSTED if episodes is None and initial_states is None else episodes
    if measures is not None:
        evaluation.register_injury()
    task = _asked_task(scenario, vehicle, settings)
    chosen = task.scenario
    lineup, objectives = made(chosen), declared_objectives(objective or (), chosen.vehicles)
    if shards is not None:
        _refuse({"--paper": paper}, "--shards prints no rows of the paper; leave one of the two out")
        number = DEFAULT.EPISODES if episodes is None else episodes
        seed = DEFAULT.LIST_SEED if seed is None else seed
        asked = evaluation.Question(chosen, tuple(lineup), number, seed, harm_count, uncertainty, tuple(objectives))
        evaluation.check_agents(lineup, chosen.sample(min(number, 1_000), seed).worlds, chosen, warn=True)
        _evaluate_in_shards(out, asked, shards, jobs, ray, output, rows)
        return
    sample, drawn_by = evaluation.choose_worlds(chosen, initial_states=initial_states, episodes=episodes, seed=seed)
    if by is not None:
        evaluation.Evaluation.check_group(sample.kinds, by)
    if paper:
        evaluation.check_papers_test(task, drawn_by)
    evaluation.check_agents(lineup, sample.worlds, chosen)
    found, beside, sheets = _drive(out, host, sample, lineup, chosen, drawn_by, harm_count)
    summary, told = evaluation.summarise(found, paper=paper), found.rescore(objectives)
    _write_report(out, report, found, summary, lineup, harm_count)
    groups = {} if by is None else evaluation.summarise_by(found, by)
    used = {"harm_count": harm_count, "uncertainty": uncertainty} | ({"host": found.host} if found.host else {})
    if per_world is not None:
        evaluation.write_per_world(per_world, found, objectives=objectives, force=out.force)
    results = evaluation.results_to_json(summary, told=told, groups=groups, per_world=per_world, settings=used)
    if per_world is not None:
        out.write(_beside(per_world), _json_text(results), f"every world: {per_world}; the results")
    shown: list[Any] = [*summary.tables()]
    for name, of_group in groups.items():
        shown += [f"\n{name}: {count_of(of_group[0].episodes, 'world')}\n", of_group.terminal()]
    shown += [*sheets, told.sheet(harm_count)] if told else sheets
    out.result([row | beside.get(row["agent"], {}) for row in results], *shown)
    _tell_horizon(out, _moving(summary), sample.worlds.n, chosen.horizon_s)


def _refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse the first of these options that is given."""
    for option in (name for name, value in options.items() if value):
        raise InvalidInput(f"{option}: {why}")


def _drive(
    out: Out, host: str | None, sample: Sample, lineup: Mapping[str, Driver], scenario: Scenario,
    seed: int | None, harm_count: HarmCount,
) -> tuple[evaluation.Evaluation, dict[str, Any], list[Any]]:  # fmt: skip
    """The agents in these worlds, and of a host by agent and as a table what it and the physics here do otherwise."""

    def tell(agent: str, done: int) -> None:
        out.progress(agent, done, sample.worlds.n)

    if host is None:
        return evaluation.evaluate(sample, lineup, scenario=scenario, seed=seed, on_progress=tell), {}, []
    from ethbrake_marl.hosts import find_host

    hosted = find_host(host)
    found, distrusted = hosted.evaluate(sample, lineup, scenario, seed, on_progress=tell)
    here = evaluation.evaluate(sample, lineup, scenario=scenario, seed=seed, aftermath=False)
    told, sheet = _beside_ours(hosted.name, found, here, distrusted, harm_count)
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


def _evaluate_group(
    out: Out, group: Sequence[Task], made: Callable[[Scenario], dict[str, Any]], episodes: int | None,
    seed: int | None,
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
    out.result(told, Sheet("", columns, rows, note))


def _check_shards(
    shards: int | None, jobs: int, ray: str | None, output: Path | None, rows: bool, measures: str | None,
    whole: Mapping[str, object],
) -> None:  # fmt: skip
    """Refuse options that do not go together; those of ``whole`` need every world at once."""
    if shards is None:
        alone = {"--jobs": jobs != 1, "--ray": ray is not None, "--output": output is not None, "--rows": rows}
        _refuse(alone, "is for an evaluation in parts; add --shards 100")
        return
    if given := [name for name, value in whole.items() if value]:
        more = "; for one row per world give --output FOLDER --rows" if "--per-world" in given else ""
        raise InvalidInput(f"{given[0]}: needs every world at once, and --shards keeps none{more}")
    if measures is not None and (jobs != 1 or ray is not None):
        raise InvalidInput("--measures: processes of --jobs and --ray know none; leave these out")
    if rows and output is None:
        raise InvalidInput("--rows: needs a folder for them: --output FOLDER")
    if rows:
        need("pyarrow")


def _check_outputs(out: Out, per_world: Path | None, report: Path | None) -> None:
    """Refuse outputs that cannot be written, or that would replace one another, before any work."""
    out.check(report, *PAGES, what="a report")
    if per_world is None:
        return
    out.check(per_world, ".csv", ".parquet", what="a file of every world")
    if per_world.suffix.lower() == ".parquet":
        need("pyarrow")
    for file in (per_world, _beside(per_world)):
        out.check(file)
        if report is not None and file.resolve() == report.resolve():
            raise InvalidInput(f"{file}: is the report, too (--report, --per-world); give another name")


def _beside(per_world: Path) -> Path:
    """The results file that stands beside a file with one row per world."""
    return per_world.with_name(f"{per_world.name}.json")


def _evaluate_in_shards(
    out: Out, question: evaluation.Question, shards: int, jobs: int, ray: str | None, output: Path | None, rows: bool
) -> None:
    """Drive the list shard by shard, and print the table that is printed without shards."""
    from ethbrake_marl.studies.jobs import evaluate_shards, open_workers

    asked = question.ask()
    if output is not None:
        out.kept = "finished shards are kept: the same command goes on"
    with ExitStack() as stack:
        # on a Ray all cores where --jobs says nothing
        workers = None if ray is None else stack.enter_context(closing(open_workers(ray, None if jobs == 1 else jobs)))
        tally = evaluate_shards(
            asked, shards=shards, jobs=jobs, workers=workers, folder=output, with_rows=rows, tell=out.show_progress
        )
    summary = asked.summarise(tally)
    results = asked.to_json(tally, summary)
    if output is not None:
        write_file(output / "results.json", _json_text(results).encode())
        out.note(f"finished shards: {output}; the results: {output / 'results.json'}")
    out.result(
        results,
        *summary.tables(),
        "Intervals: rates exact (Clopper-Pearson), means by Student's t; all from exact sums, the same bits in any"
        " number of shards.",
    )
    _tell_horizon(out, _moving(summary), tally.worlds, question.scenario.horizon_s)
    if question.objectives and not out.as_json:
        out.show(tally.rescore(question.objectives, question.scenario.vehicles).sheet(question.harm_count))


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
    path: Path | None,
    found: evaluation.Evaluation,
    rows: Sequence[evaluation.SummaryRow],
    agents: Mapping[str, Driver],
    harm_count: HarmCount,
) -> None:
    """Write the page of an evaluation that has just been made; None: none is wanted."""
    if path is None:
        return
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


@app.add("compare", "compare before.csv.json after.csv.json", json=True)
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
