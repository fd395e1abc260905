"""The first rows of the benchmark: `python -m tests.studies.benchmark_rows [AGENT ...]`.

Makes the entries of these agents anew (by default: of all rows) in docs/benchmark/v2, and puts the tables into
docs/benchmark.md. With --tables it drives nobody.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from ethbrake_marl.errors import ShownProgress
from ethbrake_marl.studies.benchmark import Suite, load_suite, read_leaderboard

ROWS = (
    "full_brake", "e_v2x_bm", "ppo@shipped", "policy@shipped", "universal@shipped", "policy@shipped+step",
    "best_harm:2000",
)  # fmt: skip
DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE, ENTRIES = DOCS / "benchmark.md", DOCS / "benchmark" / "v2"


def list_markdown(suite: Suite) -> str:
    """The lists of a suite, in Markdown."""
    lines = [
        "| List | What | Vehicles | Driven | Seed | Harm | Full braking | Best known |",
        "| --- | --- | ---: | --- | ---: | --- | ---: | ---: |",
    ]
    for each in suite.lists:
        content, scenario = each.content, each.scenario
        driven = ", ".join(str(vehicle + 1) for vehicle in scenario.learners)
        cells = (f"`{each.name}`", content.about, scenario.vehicles, driven, content.seed, content.harm_count)
        levels = (f"{content.full_brake_harm:.2f}", f"{content.best_known_harm:.2f}")
        lines.append(f"| {' | '.join(map(str, (*cells, *levels)))} |")
    return "\n".join(lines)


def page_tables() -> dict[str, str]:
    """Every table of docs/benchmark.md by its marker."""
    suite = load_suite("v2")
    found = read_leaderboard(sorted(ENTRIES.glob("*.json")), suite)
    return {"lists": list_markdown(suite), "rows": found.table().markdown()}


def main(arguments: list[str]) -> None:
    """Make entries, then the tables."""
    suite = load_suite("v2")
    for agent in [] if arguments == ["--tables"] else arguments or ROWS:
        print(agent, flush=True)
        entry = suite.make_entry(agent, on_progress=ShownProgress())
        entry.write(ENTRIES / f"{re.sub(r'[/:]', '-', agent)}.json", force=True)
    text = PAGE.read_text("utf-8")
    for marker, table in page_tables().items():
        text = re.sub(rf"(<!-- {marker} -->\n).*?(\n<!-- end -->)", rf"\g<1>{table}\g<2>", text, flags=re.DOTALL)
    PAGE.write_text(text, "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
