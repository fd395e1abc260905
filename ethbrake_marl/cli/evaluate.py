"""The command ``evaluate``."""

from __future__ import annotations

import os
import sys
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ethbrake_marl.cli.command import (
    AgentsOption,
    ForceOption,
    JobsOption,
    JsonOption,
    Out,
    ScenarioOption,
    SettingsOption,
)
from ethbrake_marl.cli.pages import page_function
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.store import check_folder

if TYPE_CHECKING:
    from ethbrake_marl.cli.settings import CommandSettings
    from ethbrake_marl.evaluation.comparison import Comparison

GROUP_EPISODES = 2_000  # worlds of each scenario of a group, except the three tests
REPORT = "report.html"
ROWS = "rows.csv"
FILES = ("results.json", "worlds.csv", ROWS, REPORT)


def evaluate_command(
    scenario: ScenarioOption = "paper-random",
    agents: AgentsOption = "full_brake,e_v2x_bm,e_v2x_bm:pairwise",
    episodes: Annotated[
        int | None, typer.Option(help="Number of worlds in the evaluation list.", show_default="10000")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = 7,
    settings: SettingsOption = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Also write the results to FOLDER/results.json.")
    ] = None,
    per_world: Annotated[
        Literal["csv"] | None,
        typer.Option(help="With --output: also write worlds.csv, with one row per world and agent."),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report", help="With --output: also write report.html, a page with tables, figures and episodes."
        ),
    ] = False,
    jobs: JobsOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare agents on the same fixed list of worlds.

    `ethbrake agent list` shows all agents; the name ladder is short for those that need no training, from bad to good.
    A name can be followed by a shield, +episode or +step; for instance full_brake+step or policy@PATH+step, where PATH
    is the folder of a run or of a policy bundle. Agents minimise the honest cost; with --set harm_count=first,
    first-impact harm, as in the paper; with harm_count=total, total harm. --set measures=pushed_mps,pushed_m adds
    measures to the results. --scenario benchmark evaluates the tasks of the benchmark, and the name of a task only this
    task.
    """
    with Out(as_json=as_json, force=force) as out:
        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.evaluation.benchmark import BENCHMARK
        from ethbrake_marl.worlds.catalogue import THREE_TESTS, group_of_scenarios
        from ethbrake_marl.worlds.physics import departures_by

        chosen = read_settings(settings, of_command=("harm_count", "measures"))
        if not isinstance(chosen.command.get("measures", ""), str):
            raise InvalidInput("--set measures: must be names with commas between them, for instance measures=pushed_m")
        names = group_of_scenarios(scenario)
        _check_outputs(out, output, names, per_world, report=report)
        if names and report:
            raise InvalidInput(
                f"--report: cannot be used with {scenario}, a group of {len(names)} scenarios; name one scenario"
            )
        if report and departures_by(physics := chosen.change_scenario(scenario).physics):
            raise InvalidInput(
                f"--report: records episodes, which needs exact impacts, and physics: {physics} has none; leave it out"
            )
        is_benchmark = scenario in (BENCHMARK, *group_of_scenarios(BENCHMARK))
        comparisons = {}
        for name in names or [scenario]:
            usual = GROUP_EPISODES if is_benchmark or (names and name not in THREE_TESTS) else 10_000
            count = usual if episodes is None else episodes
            comparisons[name] = _compare(out, name, chosen, agents, count, seed, jobs, is_benchmark=is_benchmark)
        if output is not None:
            output = _own_folder(out, output, names)
        if report and output is not None:
            write = page_function("evaluation", "--report")
            with out.writing():
                output.mkdir(parents=True, exist_ok=True)
                write(output / REPORT, comparisons[scenario], "ethbrake " + " ".join(sys.argv[1:]), force=force)
                out.note(f"report: {output / REPORT}")
        _show(out, comparisons, output, per_world, REPORT if report else "", is_benchmark=is_benchmark)


def _compare(
    out: Out, scenario: str, chosen: CommandSettings, agents: str, episodes: int, seed: int, jobs: int | None, *,
    is_benchmark: bool,
) -> Comparison:  # fmt: skip
    from ethbrake_marl.agent_names import teams_of
    from ethbrake_marl.episode.counts import HONEST, HarmCount
    from ethbrake_marl.evaluation.benchmark import benchmark_measures
    from ethbrake_marl.evaluation.comparison import Comparison

    loaded = chosen.change_scenario(scenario)
    count, measures = HarmCount.of(chosen.command.get("harm_count", HONEST)), chosen.command.get("measures", "")
    if is_benchmark:
        measures = ",".join(filter(None, [measures, *benchmark_measures(loaded, episodes=episodes, seed=seed)]))
    return Comparison.of(
        loaded, teams_of(agents, loaded, harm_count=count), episodes=episodes, seed=seed, harm_count=count,
        measures=measures, jobs=jobs or 1, on_done=lambda worlds: out.progress("worlds", worlds, episodes),
    )  # fmt: skip


def _show(
    out: Out, comparisons: dict[str, Comparison], output: Path | None, per_world: Any, page: str, *, is_benchmark: bool
) -> None:
    from ethbrake_marl.evaluation.benchmark import benchmark_rows, benchmark_sheet
    from ethbrake_marl.evaluation.results import write_results
    from ethbrake_marl.evaluation.summary import summarise_lists
    from ethbrake_marl.files.sheet import csv_text
    from ethbrake_marl.files.store import write_output

    tables = {name: comparison.table for name, comparison in comparisons.items()}
    results = {name: comparison.result for name, comparison in comparisons.items()}
    for name, table in tables.items():
        if output is None:
            break
        with out.writing():
            place = output / name if len(tables) > 1 else output
            place.mkdir(parents=True, exist_ok=True)
            for file in {*FILES} - {page} if out.force else ():
                (place / file).unlink(missing_ok=True)
            for path in write_results(place, table, results[name], per_world, force=out.force):
                out.note(f"results: {path}")
    if is_benchmark:
        rows, sheet = benchmark_rows(tables), benchmark_sheet(tables)
        if output is not None:
            with out.writing():
                write_output(output / ROWS, csv_text(rows).encode(), force=out.force)
                out.note(f"rows: {output / ROWS}")
    elif len(tables) > 1:
        sheet = summarise_lists(tables, results)
        scenarios = (name for name, table in tables.items() for _ in table)
        rows = [{"scenario": name, **row} for name, row in zip(scenarios, sheet.json(), strict=True)]
    else:
        (table,) = tables.values()
        out.result(table.to_json(), *table.tables(), in_file=output is not None)
        return
    out.result(rows, sheet, in_file=output is not None)


def _check_outputs(out: Out, output: Path | None, names: list[str], per_world: str | None, *, report: bool) -> None:
    """``names``: scenarios of the group, each with a folder in ``output``; [] for a single scenario."""
    if output is None:
        for option, value in (("--per-world", per_world), ("--report", report)):
            if value:
                raise InvalidInput(f"{option}: needs a folder for its file; add --output FOLDER")
        return
    _check_folders(output, names, force=out.force)


def _check_folders(output: Path, names: list[str], *, force: bool) -> None:
    for folder in (output, *(output / name for name in names)):
        check_folder(folder, FILES, force=force)


def _own_folder(out: Out, output: Path, names: list[str]) -> Path:
    """``output``, or a new folder beside it if another process has written results there meanwhile."""
    try:
        _check_folders(output, names, force=out.force)
    except AlreadyExists:
        places = (Path(f"{output.absolute()}-{k}") for k in count(2))
        beside = next(place for place in places if not os.path.lexists(place))
        out.unwritten.append(
            AlreadyExists(
                f"{output}: another process has written results here meanwhile; these results are in {beside}"
            )
        )
        return beside
    return output
