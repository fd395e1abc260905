"""The first rows of the benchmark: `python -m tests.studies.benchmark_rows [AGENT ...]`.

Makes the entries of these agents anew (by default: of all rows) in docs/benchmark/v2, and puts the tables into
docs/results/benchmark.json. With --tables it drives nobody.
"""

import re
import sys
from typing import Any

from ethbrake_marl.errors import ShownProgress
from ethbrake_marl.studies.benchmark import load_suite, read_leaderboard
from tests.docs.site import DOCS, load

ROWS = (
    "full_brake", "e_v2x_bm", "ppo@shipped", "policy@shipped", "universal@shipped", "policy@shipped+step",
    "best_harm:2000",
)  # fmt: skip
ENTRIES = DOCS / "benchmark" / "v2"
MEASURED = load("results")


def tables() -> list[Any]:
    """The tables of docs/results/benchmark.json, their rows made from the suite and the entries."""
    suite = load_suite("v2")
    lists = []
    for each in suite.lists:
        content, scenario = each.content, each.scenario
        driven = ", ".join(str(vehicle + 1) for vehicle in scenario.learners)
        cells = (f"`{each.name}`", content.about, scenario.vehicles, driven, content.seed, content.harm_count)
        lists.append([*map(str, cells), f"{content.full_brake_harm:.2f}", f"{content.best_known_harm:.2f}"])
    board = read_leaderboard(sorted(ENTRIES.glob("*.json")), suite).table()
    rows = [[shown.in_words for shown in row] for row in board.shown()]
    old = MEASURED.read_tables("benchmark")
    return [table.model_copy(update={"rows": made}) for table, made in zip(old, (lists, rows), strict=True)]


def main(arguments: list[str]) -> None:
    """Make entries, then the tables."""
    suite = load_suite("v2")
    for agent in [] if arguments == ["--tables"] else arguments or ROWS:
        print(agent, flush=True)
        entry = suite.make_entry(agent, on_progress=ShownProgress())
        entry.write(ENTRIES / f"{re.sub(r'[/:]', '-', agent)}.json", force=True)
    (MEASURED.RESULTS / "benchmark.json").write_text(MEASURED.text_of(tables()), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
