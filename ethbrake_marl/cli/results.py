"""The results of ``evaluate`` and ``run``: printed, and written beside the rows of every world; what pictures share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from ethbrake_marl.cli.terminal import result_console, say, write_json
from ethbrake_marl.defaults import LIST_SEED, HarmCount
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation import (
    Evaluation,
    SummaryRow,
    check_target,
    horizon_note,
    rescore,
    rescored_table,
    rich_table,
)
from ethbrake_marl.evaluation.outcome import TESTS
from ethbrake_marl.evaluation.results import results_to_json, write_output, write_per_world
from ethbrake_marl.evaluation.summary import left_out_line, metrics_table
from ethbrake_marl.figures import picture_ending
from ethbrake_marl.physics import LeftOutRows

Groups = Mapping[str, Sequence[SummaryRow]]


def tell_results(
    evaluation: Evaluation,
    summary: Sequence[SummaryRow],
    groups: Groups,
    objectives: Sequence[str],
    per_world: Path | None,
    *,
    harm_count: HarmCount,
    uncertainty: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write what was asked for, then print the figures.

    Args:
        evaluation: what was driven.
        summary: its rows.
        groups: rows of each group of worlds.
        objectives: under which the results are told, too.
        per_world: file of one row per world and agent.
        harm_count: harm that agents minimised.
        uncertainty: what robust shields did not know.
        force: replace files.
        as_json: print JSON alone.

    """
    if per_world is not None:
        write_per_world(per_world, evaluation, objectives=objectives, force=force)
    told = rescore(evaluation, objectives)
    agents_told = {"harm_count": harm_count, "uncertainty": uncertainty}
    results = results_to_json(summary, told=told, groups=groups, per_world=per_world, settings=agents_told)
    if per_world is not None:
        _write_beside(per_world, results, force=force)
    if as_json:
        write_json(results)
    else:
        show_rows(summary)
        show_groups(groups)
    moving = {row.agent: row.horizon_ends for row in summary if row.policy_share is not None}
    if note := horizon_note(moving, evaluation.worlds.n, evaluation.scenario.horizon_s):
        say(note)
    if told and not as_json:
        result_console().print(rescored_table(told, harm_count))


def results_beside(per_world: Path) -> Path:
    """The results file that stands beside a file with one row per world."""
    return per_world.with_name(f"{per_world.name}.json")


def _write_beside(per_world: Path, results: object, *, force: bool) -> None:
    """Write the results file of the file with one row per world that has just been written."""
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(results_beside(per_world), content.encode(), force=force)
    say(f"every world: {per_world}; the results: {results_beside(per_world)}")


def show_rows(rows: Sequence[SummaryRow]) -> None:
    """The rows as a table."""
    result_console().print(rich_table(rows))
    if rows and rows[0].metrics:
        result_console().print(metrics_table(rows))


def show_groups(groups: Groups) -> None:
    """The rows of each group of worlds, below its name."""
    for name, rows in groups.items():
        result_console().print(f"\n{name}: {count_of(rows[0].episodes, 'world')}\n", highlight=False, markup=False)
        result_console().print(rich_table(rows))


def show_beside(beside: Mapping[str, Sequence[SummaryRow]]) -> None:
    """The rows of the other tests, each below what its test asks."""
    for test, rows in beside.items():
        result_console().print(f"\n{TESTS[test]}\n", highlight=False, markup=False)
        result_console().print(rich_table(rows))


def counted_without(left_out: LeftOutRows) -> str:
    """What a caption says of worlds that count in no figure; nothing where there are none."""
    return f" Left out: {len(left_out):,}, which the physics could not advance." if left_out else ""


def tell_left_out(left_out: LeftOutRows, whole: int) -> None:
    """Name the worlds that count in no figure, of ``whole``, in a line on stderr; none where every world counts."""
    if left_out:
        say(left_out_line([f"world {world} of seed {LIST_SEED} ({reason})" for world, reason in left_out], whole))


def picture_target(output: Path, *, force: bool) -> Path:
    """The file to write, checked before any work."""
    picture_ending(output)
    return check_target(output, force=force)
