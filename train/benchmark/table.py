"""The benchmark's table and figure, from committed rows.

    python train/benchmark/table.py                                    # the committed rows, docs/results/benchmark
    python train/benchmark/table.py mine/*.csv --figure benchmark.png

Rows come from `train/benchmark/run.py` (one for each task, method and seed) and from `ethbrake evaluate --scenario
benchmark --output` (one for each task and agent). The scale of a task is in the rows of `full_brake`: the share of the
possible reduction is 0 for its honest cost, and 1 for the best known cost.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import bootstrap, trim_mean

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, write_picture
from ethbrake_marl.files.sheet import Column, Estimate

ROWS = Path(__file__).resolve().parents[2] / "docs" / "results" / "benchmark"
Row = Mapping[str, str]
Cells = dict[tuple[str, str], list[Row]]  # (task, method) -> rows of its seeds
HEAD = (
    *("method", "seeds", "decisions", "CPU s", "share of the possible", "honest cost", "worst 5 %"),
    *("worst-off vehicle", "first-impact harm", "total harm", "collisions", "push"),
)
MEANS = ("worst5_honest", "maximin_honest", "first_impact_harm", "total_harm", "collision_rate", "pushed_mps")
PERCENT = Column("", digits=1, scale=100.0, unit=" %")


def read_rows(files: Iterable[Path]) -> Cells:
    """Rows by task and method.

    Raises `InvalidInput` for a file without the columns, rows of other worlds or physics than the task's first row,
    two rows of one seed, and rows of a method with other decisions or another version than its first row.
    """
    cells: Cells = defaultdict(list)
    worlds: dict[str, tuple[str, str]] = {}
    for file in sorted(files):
        for row in csv.DictReader(file.read_text().splitlines()):
            if missing := [name for name in ("task", "worlds_sha256", *MEANS) if name not in row]:
                raise InvalidInput(f"{file}: lacks the column {missing[0]}; must have rows of run.py or of evaluate")
            identity = row["worlds_sha256"], row["physics_digest"]
            if worlds.setdefault(row["task"], identity) != identity:
                raise InvalidInput(f"{file}: {row['task']}: has other worlds or another physics than other files")
            cell = cells[row["task"], row.get("method") or row["agent"]]
            where = f"{file}: {row['task']}, {row.get('method') or row['agent']}"
            if any(other.get("seed") == row.get("seed") for other in cell):
                raise InvalidInput(f"{where}: another row has the same seed; leave one of them out")
            for name in ("decisions", "version"):
                if cell and cell[0].get(name) != row.get(name):
                    raise InvalidInput(f"{where}: {name} = {row.get(name)}, but {cell[0].get(name)} in another row")
            cell.append(row)
    return cells


def interquartile_mean(values: Iterable[float]) -> Estimate:
    """Mean without the lowest and the highest quarter, with a bootstrap interval over seeds (Agarwal et al. 2021)."""
    numbers = np.array([*values], np.float64)
    middle = float(trim_mean(numbers, 0.25))
    if len(numbers) < 2:
        return Estimate(middle, None)
    again = bootstrap(
        [numbers], lambda drawn, axis: trim_mean(drawn, 0.25, axis=axis), n_resamples=10_000, method="percentile", rng=0
    )
    return Estimate(middle, (float(again.confidence_interval.low), float(again.confidence_interval.high)))


def scale_of(cells: Cells, task: str) -> tuple[float, float]:
    """Honest cost of full braking and best known honest cost of a task. Raises `InvalidInput` without `full_brake`."""
    if (task, "full_brake") not in cells:
        raise InvalidInput(f"{task}: has no row of full_brake, which has the scale; add the file of its evaluation")
    row = cells[task, "full_brake"][0]
    return float(row["honest_cost"]), float(row["best_known_honest"])


def shares_of(cells: Cells, task: str, method: str) -> Estimate:
    full, best = scale_of(cells, task)
    return interquartile_mean((full - float(row["honest_cost"])) / (full - best) for row in cells[task, method])


def methods_of(cells: Cells, task: str) -> list[str]:
    """Methods with rows of a task, the best first."""
    methods = [method for at, method in cells if at == task]
    return sorted(methods, key=lambda method: -shares_of(cells, task, method).value)


def table(cells: Cells, task: str) -> list[list[str]]:
    """Rows of a task's table: the methods, and the best known cost."""
    rows = [[*HEAD], ["---", *["---:"] * (len(HEAD) - 1)]]
    for method in methods_of(cells, task):
        seeds = cells[task, method]
        spent = [float(row["cpu_s"]) for row in seeds if row.get("cpu_s")]
        decisions = f"{int(seeds[0]['decisions']):,}" if seeds[0].get("decisions") else ""
        cost = interquartile_mean(float(row["honest_cost"]) for row in seeds)
        means = [interquartile_mean(float(row[name]) for row in seeds).value for name in MEANS]
        *harms, collisions, push = means
        rows.append([
            f"`{method}`{' †' if seeds[0]['sees_through_channel'] == 'True' else ''}", f"{len(seeds)}", decisions,
            f"{np.mean(spent):.0f}" if spent else "", PERCENT.show(shares_of(cells, task, method)).in_words,
            cost.in_words(), *(f"{harm:.2f}" for harm in harms), PERCENT.show(collisions).value, f"{push:.2f}",
        ])  # fmt: skip
    best = f"{scale_of(cells, task)[1]:.2f}"
    return [*rows, ["best known (search)", "", "", "", "100.0 %", best, *[""] * len(MEANS)]]


def overview(cells: Cells) -> list[list[str]]:
    """Rows of the first table: the share of each method (row) in each task (column), and the scale."""
    tasks = tasks_of(cells)
    methods = list(dict.fromkeys(method for task in tasks for method in methods_of(cells, task)))
    rows = [["method", *(f"`{task}`" for task in tasks)], ["---", *["---:"] * len(tasks)]]
    for method in methods:
        shares = [shares_of(cells, task, method) if (task, method) in cells else None for task in tasks]
        rows.append([f"`{method}`", *(PERCENT.show(share).in_words for share in shares)])
    scales = [scale_of(cells, task) for task in tasks]
    for number, name in enumerate(("full braking, honest cost", "best known, honest cost")):
        rows.append([name, *(f"{scale[number]:.2f}" for scale in scales)])
    return rows


def tasks_of(cells: Cells) -> list[str]:
    return sorted({task for task, _ in cells})


def text_of(cells: Cells) -> str:
    """All tables as Markdown: the overview, and one for each task."""
    tables = {"": overview(cells)} | {f"## {task}\n\n": table(cells, task) for task in tasks_of(cells)}
    lines = {heading: "\n".join(f"| {' | '.join(row)} |" for row in rows) for heading, rows in tables.items()}
    return "\n\n".join(f"{heading}{text}" for heading, text in lines.items())


@in_our_style
def draw(cells: Cells, tasks: list[str]) -> Figure:
    """Share of the possible reduction of each method, with its interval over the seeds; a panel for each task."""
    columns = min(len(tasks), 2)
    figure, panels = new_panels((9.4, 2.6 * -(-len(tasks) // columns)), -(-len(tasks) // columns), columns)
    for axes, task in zip(panels, tasks, strict=False):
        methods = methods_of(cells, task)[::-1]
        shares = [shares_of(cells, task, method) for method in methods]
        values = np.array([[share.value, *share.ends] for share in shares]).T * 100
        axes.errorbar(values[0], methods, xerr=[values[0] - values[1], values[2] - values[0]], fmt="o", capsize=3)
        axes.axvline(100, color=GREY, linestyle="--", linewidth=1.1)
        axes.set(title=task, xlabel="share of the possible reduction (%)", xlim=(-10, 110))
    return finish(figure, "Interquartile means over seeds with 95 % bootstrap intervals; rules have one value.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", type=Path, help="files of rows (default: the committed ones)")
    parser.add_argument("--figure", type=Path, help="also draw the figure to this file")
    args = parser.parse_args()
    try:
        cells = read_rows(args.rows or ROWS.glob("*.csv"))
        print(text_of(cells))
        if args.figure:
            write_picture(args.figure, draw(cells, tasks_of(cells)), force=True)
    except (InvalidInput, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
