"""The commands that compare agents: ``evaluate``, ``compare`` and ``shield``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ethbrake_marl.cli.command import (
    AgentsOption,
    ForceOption,
    JobsOption,
    JsonOption,
    Out,
    RayOption,
    ScenarioOption,
    SettingsOption,
)
from ethbrake_marl.cli.pages import page_of
from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.files.store import check_folder, write_output
from ethbrake_marl.first_edition import evaluation, scenario as scenarios, training

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.physics.left_out import LeftOutRows
    from ethbrake_marl.first_edition.scenario.sample import Sample
    from ethbrake_marl.first_edition.scenario.task import Task
    from ethbrake_marl.first_edition.training.settings import Settings

# default number of worlds of each scenario in a group; best known harms exist for these worlds of `benchmark`
GROUP_EPISODES = 400

RESULTS, WORLDS, REPORT = "results.json", "worlds", "report.html"  # names of files in the folder of an evaluation

_FILES = (RESULTS, f"{WORLDS}.csv", f"{WORLDS}.parquet", REPORT)

_HARMS = {"first_impact_harm": "First-impact harm", "total_harm": "Total harm", "harm": "Harm"}

_POLICIES = {"same": "the same", "other": "another", "none": ""}


def read_task(scenario: str, settings: Sequence[str] | None) -> Task:
    """Load a scenario (name or path), apply settings ``KEY=VALUE``, and return the task of controlling its learners.

    The settings may include ``harm_count=total``. Raises ``InvalidInput`` if the scenario has no learner.
    """
    return _task_of(scenario, training.read_settings(settings, of_agents=("harm_count",)))


def _task_of(scenario: str, chosen_settings: Settings) -> Task:
    from ethbrake_marl.first_edition.scenario.task import Task

    chosen = evaluation.load_runnable(scenario, chosen_settings.scenario, drives="some")
    return Task(chosen, chosen.learners, chosen_settings.harm_count)


def make_drivers(agents: str | Sequence[str], task: Task, *, bare: bool = False) -> dict[str, Any]:
    """Return the agents named on a command line, by name (``make_lineup``, where ``agents`` are ``specs``)."""
    return evaluation.make_lineup(agents, task.scenario, harm_count=task.harm_count, bare=bare)


def evaluate_command(
    scenario: ScenarioOption = "paper-random",
    agents: AgentsOption = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[
        int | None, typer.Option(help="Number of worlds in the evaluation list.", show_default="10000")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the evaluation list.", show_default="7")] = None,
    settings: SettingsOption = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also write the results to FOLDER/results.json.")
    ] = None,
    per_world: Annotated[
        Literal["csv", "parquet"] | None,
        typer.Option(help="With --output: also write worlds.csv or worlds.parquet, with one row per world and agent."),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report", help="With --output: also write report.html, a page with tables, figures and episodes."
        ),
    ] = False,
    jobs: JobsOption = None,
    ray: RayOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agent list` shows all agents; the name ladder is short for all agents from coast to best_harm in this
    list. A name can be followed by +search and by one shield, +episode or +step; for instance full_brake+step or
    ppo@PATH+search+episode, where PATH is the folder of a run or of a policy bundle. The shield +robust needs the
    description of an uncertainty, which can be given only in Python; +robust:estimated needs no description. With --set
    harm_count=total, agents minimise total harm instead of first-impact harm. --set measures=injury,my_file.py:worst
    adds these measures to the results.
    """
    from ethbrake_marl.first_edition.agents.spec import split_specs

    with Out(as_json=as_json, force=force) as out:
        from ethbrake_marl.first_edition.game.harm import HARM_COUNTS  # loads numba, which help does not need

        _check_outputs(out, output, per_world, report=report)
        write_page = page_of("evaluation", "--report") if report else None
        chosen = training.read_settings(settings, of_agents=("harm_count", "measures"))
        if group := scenarios.group_of_scenarios(scenario):
            other = {"--per-world": per_world, "--report": report, "--jobs": jobs, "--ray": ray}
            for option in (name for name, value in other.items() if value):
                raise InvalidInput(
                    f"{option}: cannot be used with {scenario}, a group of {len(group)} scenarios; name a single"
                    " scenario"
                )
            if chosen.measures:
                raise InvalidInput(
                    f"--set measures: cannot be used with {scenario}, a group of {len(group)} scenarios; name a single"
                    " scenario"
                )
            _evaluate_group(out, output, [_task_of(name, chosen) for name in group], agents, episodes, seed)
            return
        task = _task_of(scenario, chosen)
        lineup = evaluation.Lineup.of(
            split_specs(agents), task.scenario, harm_count=task.harm_count, measures=chosen.measures
        )
        used = {"harm_count": task.harm_count}
        seed = evaluation.LIST_SEED if seed is None else seed
        episodes = evaluation.EPISODES if episodes is None else episodes
        if episodes > evaluation.HELD and not (per_world or report):
            summary, borne = _evaluate_long_list(out, lineup, episodes, seed, jobs, ray)
            results = evaluation.results_to_json(summary, rescored=borne, settings=used)
        else:
            sample = task.scenario.sample(episodes, seed)
            evaluation.check_agents(lineup.make(), sample.worlds, task.scenario, warn=True)
            tell = _tell_worlds(out, sample.worlds.n)
            result = evaluation.evaluate_held(lineup, sample, seed, jobs=jobs, ray=ray, on_done=tell)
            summary, borne = evaluation.summarise(result), result.rescore(_objectives(task.scenario))
            beside_it = _write_worlds(out, output, result, per_world)
            results = evaluation.results_to_json(summary, rescored=borne, per_world=beside_it, settings=used)
            if write_page is not None and output is not None:
                output.mkdir(parents=True, exist_ok=True)
                write_page(
                    output / REPORT, result, summary, lineup.make(), harm_count=task.harm_count, force=out.force,
                    tell=lambda done, total: out.progress("report: episodes", done, total),
                )  # fmt: skip
                out.note(f"report: {output / REPORT}")
        _write_results(out, output, results, f"{WORLDS}.{per_world}", REPORT if report else "")
        out.result(
            results, *summary.tables(), *(part for count in HARM_COUNTS if borne for part in ("", borne.sheet(count)))
        )
        _tell_horizon(out, _moving(summary), summary[0].episodes, task.scenario.horizon_s)


def _evaluate_long_list(
    out: Out, lineup: evaluation.Lineup, episodes: int, seed: int, jobs: int | None, ray: str | None
) -> tuple[evaluation.SummaryTable, evaluation.Rescores]:
    """Return the results table of an evaluation list that is too long for the memory, and the vehicles' objectives."""
    scenario = lineup.scenario
    evaluation.check_agents(lineup.make(), scenario.sample(1_000, seed).worlds, scenario, warn=True)
    objectives, tell = _objectives(scenario), _tell_worlds(out, episodes)
    tally = evaluation.tally_list(lineup, episodes, seed, objectives=objectives, jobs=jobs, ray=ray, on_done=tell)
    return evaluation.summarise_tally(lineup, tally, seed), tally.rescore(objectives, scenario.vehicles)


def _objectives(scenario: scenarios.Scenario) -> list[str]:
    """Return the objectives to show for each vehicle: none if all vehicles minimise the harm of the whole line.

    Otherwise the list has ``own``, the harm that each vehicle bears, and the scenario's objectives.
    """
    declared = scenario.objective
    every = {declared} if isinstance(declared, str) else {*declared}
    return [] if every == {"total"} else ["own", *sorted(every - {"own"})]


def _tell_worlds(out: Out, worlds: int) -> Callable[[int], None]:
    def tell(done: int) -> None:
        out.progress("worlds", done, worlds)

    return tell


def _evaluate_group(
    out: Out, output: Path | None, group: Sequence[Task], agents: str, episodes: int | None, seed: int | None
) -> None:
    """Evaluate each agent in each scenario of a group, and print a table with a row per agent and scenario."""
    objects: list[dict[str, Any]] = []
    rows: list[Any] = []
    seed = evaluation.LIST_SEED if seed is None else seed
    more = [each.group_column for each in evaluation.MEASURE_SETS.values() if each.group_column]
    for task in group:
        chosen = task.scenario
        sample = chosen.sample(GROUP_EPISODES if episodes is None else episodes, seed)
        lineup = make_drivers(agents, task)
        evaluation.check_agents(lineup, sample.worlds, chosen)
        result = evaluation.evaluate(sample, lineup, scenario=chosen, seed=seed)
        rows.append(chosen.name)
        for row in evaluation.summarise(result):
            outcome, shares = result.outcome(row.agent), [row[each.measures[task.harm_count]] for each in more]
            hardest = 3.6 * math.sqrt(outcome.ledger.pair_harm("first").max(initial=0.0))
            each: dict[str, Any] = {
                "passed": not outcome.collided.any(),
                "collision_rate": float(outcome.collided.mean()),
                "hardest_impact_kmh": hardest,
                "first_impact_harm": float(outcome.first_impact_harm.mean()),
                "total_harm": float(outcome.total_harm.mean()),
            }
            shown = f"{each['collision_rate']:.1%}", f"{hardest:.1f}", *(f"{each[key]:.2f}" for key in list(each)[3:])
            rows.append((row.agent, "passed" if each["passed"] else "failed", *shown, *shares))
            for head, share in zip(more, shares, strict=True):
                each[head.column.name] = None if share is None else share.to_json()
            objects.append({"scenario": chosen.name, "agent": row.agent, "worlds": result.worlds.n, **each})
    columns: list[Column | str] = [
        "Agent",
        "Result",
        Column("Collisions"),
        Column("Hardest, km/h", short="Hardest,\nkm/h"),
        Column("First-impact harm", short="First-impact\nharm"),
        Column("Total harm", short="Total\nharm"),
        *(each.column for each in more),
    ]
    counted = "first-impact" if group[0].harm_count == "first" else "total"
    note = (
        f"{result.worlds.n:,} worlds of each scenario, seed {seed}; `ethbrake scenario explain` describes a scenario."
        " Passed: no vehicle collides in any world. Harm: mean per world in m²/s². Hardest: largest closing speed of"
        " any first impact." + "".join(f" {each.note.format(harm=counted)}" for each in more)
    )
    _write_results(out, output, objects)
    out.result(objects, Sheet("", columns, rows, note))


def _check_outputs(out: Out, output: Path | None, per_world: str | None, *, report: bool) -> None:
    """Raise an error, before any work, if the results and the requested files cannot be written to ``output``."""
    if output is None:
        for option in (name for name, value in (("--per-world", per_world), ("--report", report)) if value):
            raise InvalidInput(f"{option}: needs a folder for its file; add --output FOLDER")
        return
    if per_world == "parquet":
        need("pyarrow")
    check_folder(output, _FILES, force=out.force)


def _write_worlds(out: Out, output: Path | None, result: evaluation.Evaluation, per_world: str | None) -> Path | None:
    """Write the file with one row per world and agent, if it was requested, and return its path."""
    if output is None or per_world is None:
        return None
    file = output / f"{WORLDS}.{per_world}"
    output.mkdir(parents=True, exist_ok=True)
    evaluation.write_per_world(file, result, force=out.force)
    out.note(f"results per world: {file}")
    return file


def _write_results(out: Out, output: Path | None, results: object, *beside: str) -> None:
    """Write ``results.json``, if requested; delete earlier result files that ``beside`` does not name."""
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
    """Print for each agent in how many (``moving``) of all ``worlds`` a vehicle still moves at the horizon."""
    text = ", ".join(f"{name} {count}" for name, count in moving.items() if count)
    if text:
        out.note(
            f"note: the bounds of the shield do not cover harm after the horizon ({horizon_s:g} s); worlds (of"
            f" {worlds}) in which a vehicle still moves at the horizon: {text}"
        )


def _moving(rows: Sequence[evaluation.SummaryRow]) -> dict[str, int]:
    """Return a dictionary: agent with a shield -> number of worlds in which some vehicle still moves at the horizon."""
    return {row.agent: row.horizon_ends for row in rows if row.policy_share is not None}


_FILE = typer.Argument(metavar="RESULTS.json", help="File results.json of `evaluate` or `run`, or output of --json.")


def compare_command(first: Annotated[Path, _FILE], second: Annotated[Path, _FILE], as_json: JsonOption = False) -> None:
    """Show how harm differs between two results.

    Shows the harm in the second result minus the harm in the first, for each agent that both results contain. The two
    compared results must come from the same command and the same worlds of the same scenario. Confidence intervals are
    paired by world if both folders contain the file that --per-world writes.
    """
    with Out(as_json=as_json) as out:
        comparison = evaluation.compare_results(evaluation.read_result(first), evaluation.read_result(second))
        names = [_HARMS[name] for name in comparison.differences[0].harms]
        rows = [[each.marked, _POLICIES[each.policy], *each.harms.values()] for each in comparison.differences]
        out.result(comparison.to_json(), Sheet("", ["Agent", Column("Policy", text=True), *map(Column, names)], rows))
        out.note("second minus first, mean per world in m²/s²; in brackets: 95 % intervals,")
        why = comparison.unpaired_because
        by = evaluation.Conditions(recordings=comparison.recordings).by_recording
        how = "paired by world" if why is None else f"NOT paired by world, so wider than paired intervals: {why}"
        out.note(f"{how}{by}")
        if comparison.exploits_line:
            out.note(comparison.exploits_line)
        for which, agents in zip(("first", "second"), comparison.left_over, strict=True):
            if agents:
                out.note(f"agents only in the {which} result: {', '.join(agents)}")
        for name, both in {**comparison.other_settings, **comparison.other_versions}.items():
            if "SHA-256 " in f"{both[0]}{both[1]}":  # the hash of a file, which only --json shows
                difference = "was used for only one of the results" if None in both else "differs between the results"
                out.note(f"note: {name} {difference}")
            else:
                out.note(f"note: {name}: {both[0]} in the first result, {both[1]} in the second")


def shield_command(
    agents: AgentsOption = "ppo,full_brake,constant:3",
    scenario: ScenarioOption = "paper-random",
    episodes: Annotated[int, typer.Option(help="Number of worlds in the evaluation list.")] = 2_000,
    settings: SettingsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare agents without and with the shield.

    Each agent runs in the same worlds without a shield, with the shield in episode mode, and with the shield in step
    mode. A team of several learners runs without a shield, with the shield in step mode, and with the shield in step
    mode plus caps. Write the names of the agents without a shield: full_brake, not full_brake+step. The shield bounds
    first-impact harm, or total harm with --set harm_count=total. For each action that step mode replaced, the table
    says what harm the replaced action would have caused: more (the replacement was needed), the same (harmless) or less
    (costly).
    """
    with Out(as_json=as_json) as out:
        task = read_task(scenario, settings)
        sample = task.scenario.sample(episodes, evaluation.LIST_SEED)
        rows = _measure_modes(out, agents, sample, task)
        out.result(rows.to_json(sample, task), *rows.sheets())
        _tell_left_out(out, rows[0].left_out, episodes)
        if sample.clusters is not None:
            number = len({*sample.clusters.tolist()})
            out.note(evaluation.Conditions(recordings=number).by_recording.removeprefix("; "))
        moving = {f"{row.agent} ({row.mode})": row.horizon_ends for row in rows if row.mode != "none"}
        _tell_horizon(out, moving, episodes - len(rows[0].left_out), task.scenario.horizon_s)


def _measure_modes(out: Out, agents: str, sample: Sample, task: Task) -> evaluation.ShieldModes:
    """Compare agents without and with the shield in the worlds of ``sample``, and show the progress on stderr."""
    lineup = make_drivers(agents, task, bare=True)
    n = sample.worlds.n
    return evaluation.compare_modes(
        lineup, sample.worlds, task, clusters=sample.clusters,
        on_progress=lambda name, done: out.progress(name, done, n),
    )  # fmt: skip


def _tell_left_out(out: Out, left_out: LeftOutRows, whole: int) -> None:
    """Print which of all ``whole`` worlds were left out of the results, if any."""
    if left_out:
        texts = [f"world {world} of seed {evaluation.LIST_SEED} ({reason})" for world, reason in left_out]
        out.note(evaluation.LeftOut.line(texts, whole))
