"""``ethbrake evaluate --shards``: a list of any length in flat memory, by several processes, resumable."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from ethbrake_marl.cli.results import show_rows
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, show, write_json
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, check_whole_number, need
from ethbrake_marl.evaluation import horizon_note, rescored_table
from ethbrake_marl.evaluation.inputs import check_agents, make_lineup
from ethbrake_marl.evaluation.shards import (
    Asked,
    Question,
    Tally,
    ask,
    rescore_shards,
    shards_to_json,
    summarise_shards,
)
from ethbrake_marl.files.store import write_file
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.uncertainty import parse_uncertainty
from ethbrake_marl.studies.jobs import Workers
from ethbrake_marl.studies.shards import MOST_JOBS, evaluate_shards

RESULTS = "results.json"
_INTERVALS = (
    "Intervals: rates exact (Clopper-Pearson), means by Student's t; all from exact sums, the same bits in any"
    " number of shards."
)


def check_shards(
    shards: int | None, jobs: int, ray: str | None, output: Path | None, rows: bool, others: Mapping[str, object]
) -> None:
    """Refuse options that do not go together.

    Args:
        shards: parts of the list; None: it is evaluated in one piece.
        jobs: processes.
        ray: a Ray that is to answer the shards.
        output: folder of finished shards.
        rows: one row per world and agent is asked for.
        others: options that need every world at once, by name.

    """
    if shards is None:
        alone = {"--jobs": jobs != 1, "--ray": ray is not None, "--output": output is not None, "--rows": rows}
        if given := [name for name, is_given in alone.items() if is_given]:
            raise InvalidInput(f"{given[0]}: is for an evaluation in parts; add --shards 100")
        return
    if given := [name for name, value in others.items() if value]:
        more = "; for one row per world give --output FOLDER --rows" if "--per-world" in given else ""
        raise InvalidInput(f"{given[0]}: needs every world at once, and --shards keeps none{more}")
    check_whole_number("shards", shards, 1)
    check_whole_number("jobs", jobs, 1, MOST_JOBS)
    if rows and output is None:
        raise InvalidInput("--rows: needs a folder for them: --output FOLDER")
    if rows:
        need("pyarrow")
    if ray is not None:
        need("ray")


def evaluate_in_shards(
    scenario: Scenario,
    agents: Sequence[str],
    *,
    shards: int,
    jobs: int,
    ray: str | None,
    output: Path | None,
    rows: bool,
    episodes: int,
    seed: int,
    harm_count: HarmCount,
    uncertainty: str | None,
    objectives: Sequence[str],
    as_json: bool,
) -> None:
    """Drive the list shard by shard, and print the table that is printed without shards.

    Args:
        scenario: with the learners that are driven.
        agents: as they were written.
        shards: parts of the list.
        jobs: processes.
        ray: address of a cluster, or local; None: processes of this machine.
        output: folder that keeps finished shards; None: nothing is kept.
        rows: keep one row per world and agent, too.
        episodes: worlds of the list.
        seed: of the list.
        harm_count: harm that agents minimise.
        uncertainty: what robust shields do not know.
        objectives: under which results are told, too.
        as_json: print JSON alone.

    """
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(agents, scenario, harm_count=harm_count, uncertainty=intervals)
    question = Question(scenario, tuple(lineup), episodes, seed, harm_count, uncertainty, tuple(objectives))
    check_agents(lineup, scenario.sample(1, seed).worlds, scenario)
    asked = ask(question)
    kept = "nothing was written" if output is None else "finished shards are kept: the same command goes on"
    with interruptible(kept), progress_bars() as bars, ExitStack() as stack:
        workers = None if ray is None else stack.enter_context(closing(_on_ray(ray, jobs)))
        tally = evaluate_shards(
            asked, shards=shards, jobs=jobs, workers=workers, folder=output, with_rows=rows, tell=bars.show_progress
        )
    _tell(asked, tally, output, as_json=as_json)


def _tell(asked: Asked, tally: Tally, output: Path | None, *, as_json: bool) -> None:
    """Write the results beside the finished shards, and print the table."""
    question, summary = asked.question, summarise_shards(asked, tally)
    results = shards_to_json(asked, tally, summary)
    if output is not None:
        write_file(output / RESULTS, (json.dumps(results, indent=2, allow_nan=False) + "\n").encode())
        say(f"finished shards: {output}; the results: {output / RESULTS}")
    if as_json:
        write_json(results)
    else:
        show_rows(summary)
        show(_INTERVALS)
    moving = {row.agent: row.horizon_ends for row in summary if row.policy_share is not None}
    if note := horizon_note(moving, tally.worlds, question.scenario.horizon_s):
        say(note)
    if question.objectives and not as_json:
        result_console().print(rescored_table(rescore_shards(asked, tally), question.harm_count))


def _on_ray(address: str, jobs: int) -> Workers:
    """A Ray, with all its cores where ``jobs`` is 1, which says nothing."""
    from ethbrake_marl.studies.jobs import LOCAL, RayWorkers

    most = None if jobs == 1 else jobs
    return RayWorkers(address, len(os.sched_getaffinity(0)) if address == LOCAL and most is None else most)
