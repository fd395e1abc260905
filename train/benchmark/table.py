"""The benchmark's tables and figure, from rows.

    python train/benchmark/table.py                     # the committed rows, docs/results/benchmark
    python train/benchmark/table.py mine/rows/*.csv     # your own rows, also of a trial in fewer worlds
    python train/benchmark/table.py --csv docs/results/benchmark.csv --figure docs/figures/benchmark.png

Rows come from `train/benchmark/run.py` (one for each task, method and seed) and from `ethbrake evaluate --scenario
benchmark --output` (one for each task and agent). The first table has the share of the possible reduction (0 for full
braking, 1 for the best known cost of the shipped tables); the second table, also written by `--csv`, has all measures.
Both mark agents that read hidden values (†). For the committed rows, two more tables follow: differences in honest
cost, and the held-out lists. `docs/results/benchmark/variants` has rows of shorter trainings and of other processor
instructions.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import product
from math import isfinite
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import t, trim_mean

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.benchmark import BENCHMARK, EPISODES
from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, write_picture
from ethbrake_marl.extensions.search.limits import least_known_values
from ethbrake_marl.files.sheet import DASH, Column, Estimate, csv_text
from ethbrake_marl.files.store import check_target, write_file
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import group_of_scenarios

ROWS = Path(__file__).resolve().parents[2] / "docs" / "results" / "benchmark"
Row = dict[str, str]
Cells = dict[tuple[str, str], list[Row]]  # (task, method) -> rows of its seeds
SHARE = "share_of_possible_reduction_honest"
MEANS = {  # column of the rows -> column of the table
    "worst5_honest": "worst 5 %",
    "maximin_honest": "worst-off vehicle",
    "first_impact_harm": "first-impact harm",
    "total_harm": "total harm",
    "collision_rate": "collisions",
    "pushed_mps": "push",
}
NUMBERS = (SHARE, "honest_cost", "best_known_honest", *MEANS)
OF_A_TASK = ("worlds_sha256", "physics_digest", "best_known_honest")  # columns with one value in all rows of a task
OF_A_METHOD = ("decisions", "version", "sees_through_channel")  # columns with one value in all seeds of a method
NEEDED = ("task", "worlds_sha256", "physics_digest", "agent", "sees_through_channel", *NUMBERS)
OPTIONAL = dict.fromkeys(("seed", "decisions", "simulated", "start", "cpu_s", "version"), "")
PERCENT = Column("", digits=1, scale=100.0, unit=" %")


def read_rows(files: Iterable[Path]) -> Cells:
    """Rows by task and method.

    Raises `InvalidInput` for a file that `checked_rows` refuses, rows that differ in `OF_A_TASK` from the task's first
    row or in `OF_A_METHOD` from the method's first row, two rows of one seed, and no rows at all.
    """
    cells: Cells = defaultdict(list)
    for row in (row for file in sorted(files) for row in checked_rows(file)):
        cell = cells[row["task"], row["method"]]
        if any(other["seed"] == row["seed"] for other in cell):
            raise InvalidInput(f"{row['where']}: another row has the same seed; leave one of them out")
        cell.append(row)
    if not cells:
        raise InvalidInput("no rows: needs a file of run.py or of evaluate")
    for task in tasks_of(cells):
        rate(cells, task)
    first = {task: rows[0] for (task, _), rows in reversed(cells.items())}
    for (task, _), seeds in cells.items():
        others = [(name, first[task]) for name in OF_A_TASK] + [(name, seeds[0]) for name in OF_A_METHOD]
        for row, (name, other) in product(seeds, others):
            if row[name] != other[name]:
                raise InvalidInput(f"{row['where']}: {name} = {row[name]}, but {other[name]} in another row")
    return cells


def rate(cells: Cells, task: str) -> None:
    """Shares anew, from the shipped table of best known costs, for rows of the first list of a task."""
    if task in group_of_scenarios(BENCHMARK) and (task, "full_brake") in cells:
        braking, (scenario, game) = cells[task, "full_brake"][0], eb.open_game(task)
        worlds = scenario.sample(int(braking.get("episodes") or EPISODES), SEED)
        best, full = float(least_known_values(game, worlds)["honest"].mean()), float(braking["honest_cost"])
        for row in (row for (at, _), seeds in cells.items() if at == task for row in seeds):
            row["best_known_honest"] = f"{best:.9g}"
            row[SHARE] = repr((full - float(row["honest_cost"])) / (full - best))


def checked_rows(file: Path) -> Iterator[Row]:
    """Rows of a file, each with its place (`where`) and with all columns of `OPTIONAL`. Numbers have one notation.

    Raises `InvalidInput` for a file without rows or without a column, and for a value that is not as in `CHECKS`.
    """
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            reader = csv.DictReader(lines, restval="")
            rows, names = [*reader], reader.fieldnames or ()
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(f"{file}: is no CSV file in UTF-8 ({error})") from None
    if missing := [name for name in NEEDED if name not in names]:
        raise InvalidInput(f"{file}: lacks the column {missing[0]}; must have rows of run.py or of evaluate")
    if not rows:
        raise InvalidInput(f"{file}: has no rows")
    for written in rows:
        row = {**OPTIONAL, **written, "method": written.get("method") or written["agent"]}
        row["where"] = f"{file}: {row['task']}, {row['method']}"
        if not row[SHARE]:
            right = "evaluate full_brake beside it, in worlds of the benchmark's lists"
            raise InvalidInput(f"{row['where']}: has no share of the possible reduction; {right}")
        for name, (is_right, right) in CHECKS.items():
            if not (is_right(row[name]) or row[name] == OPTIONAL.get(name)):
                raise InvalidInput(f"{row['where']}: {name} = {row[name]!r}: must be {right}")
        row |= {name: f"{int(row[name])}" for name in ("seed", "decisions") if row[name]}
        row["best_known_honest"] = f"{float(row['best_known_honest']):.9g}"  # machines may differ in the last digit
        yield row


def is_finite(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def is_name(text: str) -> bool:
    return bool(text) and text.isprintable() and "|" not in text


CHECKS = {  # column -> what is right, in code and in words
    "task": (is_name, "a name without |"),
    "method": (is_name, "a name without |"),
    **dict.fromkeys(("seed", "decisions"), (str.isdecimal, "a whole number")),
    **dict.fromkeys((*NUMBERS, "cpu_s"), (is_finite, "a finite number")),
    "sees_through_channel": (("True", "False").__contains__, "True or False"),
}


def interquartile_mean(values: Iterable[float]) -> Estimate:
    """Mean without the lowest and the highest quarter, with a bootstrap interval over seeds (Agarwal et al. 2021)."""
    numbers = np.array([*values], np.float64)
    middle = float(trim_mean(numbers, 0.25))
    if len(numbers) < 2:
        return Estimate(middle, None)
    return Estimate(middle, percentiles(trim_mean(redrawn(numbers, 0), 0.25, axis=1)))


def redrawn(numbers: Floats, seed: int) -> Floats:
    """Bootstrap samples, [10,000, seeds]."""
    return np.random.default_rng(seed).choice(numbers, (10_000, len(numbers)))


def percentiles(values: Floats) -> tuple[float, float]:
    low, high = np.nanpercentile(values, (2.5, 97.5)).tolist()
    return low, high


def shares_of(cells: Cells, task: str, method: str) -> Estimate:
    return interquartile_mean(float(row[SHARE]) for row in cells[task, method])


def mark_of(cells: Cells, task: str, method: str) -> str:
    """Mark of an agent that reads values which the channel hides in this task."""
    return " †" if cells[task, method][0]["sees_through_channel"] == "True" else ""


def methods_of(cells: Cells, task: str) -> list[str]:
    """Methods with rows of a task, the best first."""
    methods = [method for at, method in cells if at == task]
    return sorted(methods, key=lambda method: -shares_of(cells, task, method).value)


def table(cells: Cells) -> list[dict[str, str]]:
    """All measures: a row for each task and method, and for the best known cost of each task."""
    rows = []
    for task in tasks_of(cells):
        for method in methods_of(cells, task):
            seeds = cells[task, method]
            spent = [float(row["cpu_s"]) for row in seeds if row["cpu_s"]]
            decisions = seeds[0]["decisions"]
            means = {name: interquartile_mean(float(row[key]) for row in seeds).value for key, name in MEANS.items()}
            rows.append({
                "task": task,
                "method": method + mark_of(cells, task, method),
                "seeds": f"{len(seeds)}",
                "decisions": f"{int(decisions):,}" if decisions else "",
                "simulated": f"{factor:,.0f}" if (factor := factor_of(cells, task, method)) else "",
                "start": seeds[0]["start"],
                "CPU s": f"{np.mean(spent):.0f}" if spent else "",
                "share of the possible": PERCENT.show(shares_of(cells, task, method)).in_words,
                "a further training": further(float(row[SHARE]) for row in seeds),
                "better than the next": improvement(cells, task, method),
                "honest cost": interquartile_mean(float(row["honest_cost"]) for row in seeds).in_words(),
                **{name: f"{mean:.2f}" for name, mean in means.items()},
                "collisions": PERCENT.show(means["collisions"]).value,
            })  # fmt: skip
        best = {"share of the possible": "100.0 %", "honest cost": best_known(cells, task)}
        rows.append(dict.fromkeys(rows[0], "") | {"task": task, "method": "best known (search)", **best})
    return rows


def factor_of(cells: Cells, task: str, method: str) -> float:
    """Simulated decisions for each decision of the budget; 0 for rules."""
    ratios = [int(row["simulated"]) / int(row["decisions"]) for row in cells[task, method] if row["simulated"]]
    return float(np.mean(ratios)) if ratios else 0.0


def further(values: Iterable[float]) -> str:
    """Prediction interval (Student's t) of one more training, which is wider than that of the mean."""
    numbers = np.array([*values])
    if len(numbers) < 3:
        return ""
    half = t.ppf(0.975, len(numbers) - 1) * numbers.std(ddof=1) * (1.0 + 1.0 / len(numbers)) ** 0.5
    return PERCENT.show(Estimate(float(numbers.mean()), (numbers.mean() - half, numbers.mean() + half))).in_words


def improvement(cells: Cells, task: str, method: str) -> str:
    """Probability that a training is better than one of the next method in the table, with a bootstrap interval."""
    methods = methods_of(cells, task)
    pair = methods[methods.index(method) :][:2]
    if len(pair) < 2 or len(cells[task, method]) < 2:
        return ""
    one, other = (np.array([float(row[SHARE]) for row in cells[task, name]]) for name in pair)
    first, second = redrawn(one, 0)[:, :, np.newaxis], redrawn(other, 1)[:, np.newaxis]
    drawn = ((first > second) + 0.5 * (first == second)).mean(axis=(1, 2))
    value = (one[:, np.newaxis] > other).mean() + 0.5 * (one[:, np.newaxis] == other).mean()
    return PERCENT.show(Estimate(float(value), percentiles(drawn))).in_words


def best_known(cells: Cells, task: str) -> str:
    (row, *_), *_ = (rows for (at, _), rows in cells.items() if at == task)
    return f"{float(row['best_known_honest']):.2f}"


def overviews(cells: Cells) -> list[list[dict[str, str]]]:
    """Overviews of the tasks with several learners, which some methods need, of those with one, and of others."""
    tasks, known = tasks_of(cells), group_of_scenarios(BENCHMARK)
    several = [task for task in tasks if task in known and len(eb.load_scenario(task).learners) > 1]
    one = [task for task in tasks if task in known and task not in several]
    others = [task for task in tasks if task not in known]
    return [overview(cells, group) for group in (several, one, others) if group]


def overview(cells: Cells, tasks: list[str]) -> list[dict[str, str]]:
    """The share of each method (row) in each task (column), and the scale.

    First methods that simulate only their decisions, then those that simulate more, then rules; in each group the best
    in the task of most methods first.
    """
    rows = []
    usual = max(tasks, key=lambda task: len(methods_of(cells, task)))
    for method in dict.fromkeys(method for task, method in cells if task in tasks):
        own = [task for task in tasks if (task, method) in cells]
        factor = float(np.mean([factor_of(cells, task, method) for task in own]))
        shares = {task: shares_of(cells, task, method) for task in own}
        texts = {task: PERCENT.show(shares[task]).in_words + mark_of(cells, task, method) for task in own}
        group, best = int(factor > 1.01) if factor else 2, shares.get(usual, Estimate(-1.0, None)).value
        first = {"method": method, "simulated": f"{factor:,.0f}" if factor else DASH}
        rows.append((group, -best, first | dict.fromkeys(tasks, DASH) | texts))
    full = {task: cells[task, "full_brake"][0]["honest_cost"] for task in tasks if (task, "full_brake") in cells}
    costs = {task: f"{float(full[task]):.2f}" if task in full else DASH for task in tasks}
    return [row for _, _, row in sorted(rows, key=lambda row: row[:2])] + [
        {"method": "full braking, honest cost", "simulated": ""} | costs,
        {"method": "best known, honest cost", "simulated": ""} | {task: best_known(cells, task) for task in tasks},
    ]


def differences(cells: Cells) -> list[dict[str, str]]:
    """Difference in honest cost between two cells, with its bootstrap interval over the seeds of both."""
    compared = ("sb3-ppo", "cooperation"), ("mappo", "ippo")
    pairs = [((task, one), (task, other)) for one, other in compared for task in tasks_of(cells)]
    pairs += [
        (("benchmark-blocked", method), ("benchmark-pair", method)) for method in methods_of(cells, "benchmark-pair")
    ]
    rows = []
    for one, other in pairs:
        if one in cells and other in cells:
            first, second = (np.array([float(row["honest_cost"]) for row in cells[at]]) for at in (one, other))
            drawn = [trim_mean(redrawn(costs, seed), 0.25, axis=1) for seed, costs in enumerate((first, second))]
            value = float(trim_mean(first, 0.25) - trim_mean(second, 0.25))
            difference = Estimate(value, percentiles(drawn[0] - drawn[1]) if len(first) > 1 else None)
            rows.append({"cell": ", ".join(one), "minus": ", ".join(other), "honest cost": difference.in_words()})
    return rows


def held_out(cells: Cells, files: Iterable[Path]) -> list[dict[str, str]]:
    """How much of full braking's cost each method saves on the first list and on its held-out list, mean of its tasks.

    A file of rows on a held-out list also has the rows of full braking.
    """
    rows = []
    for file in sorted(files):
        others: Cells = defaultdict(list)
        for row in csv.DictReader(file.read_text().splitlines()):
            others[row["task"], row["method"]].append(row)
        for method in sorted({method for _, method in others} - {"full_brake"}):
            tasks = [task for task, name in others if name == method]
            saved = [np.mean([saving(lists, task, method) for task in tasks]) for lists in (cells, others)]
            first, second = (PERCENT.show(Estimate(float(value), None)).value for value in saved)
            about = {"method": method, "saved, first list": first, "held-out list": second}
            rows.append(about | {"its seed": others[tasks[0], method][0]["list_seed"]})
    return rows


def saving(cells: Cells, task: str, method: str) -> float:
    cost, full = ([float(row["honest_cost"]) for row in cells[task, name]] for name in (method, "full_brake"))
    return float(1.0 - trim_mean(cost, 0.25) / full[0])


def tasks_of(cells: Cells) -> list[str]:
    return sorted({task for task, _ in cells})


def text_of(rows: list[dict[str, str]]) -> str:
    """Table as Markdown."""
    lines = [[*rows[0]], ["---", *["---:"] * (len(rows[0]) - 1)], *(row.values() for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@in_our_style
def draw(cells: Cells) -> Figure:
    """Share of the possible reduction of each method, with its interval over the seeds.

    A panel for each task in which a method has several seeds.
    """
    tasks = [task for task in tasks_of(cells) if any(len(rows) > 1 for (at, _), rows in cells.items() if at == task)]
    if not tasks:
        raise InvalidInput("--figure: needs a method with two seeds or more in a task; leave it out")
    rows = -(-len(tasks) // 2)
    figure, panels = new_panels((9.4, 2.8 * rows), rows, 2, sharex=True)
    for axes, task in zip(panels, tasks, strict=False):
        methods = [method for method in methods_of(cells, task)[::-1] if shares_of(cells, task, method).value > 0.0]
        shares = [shares_of(cells, task, method) for method in methods]
        values = np.array([[share.value, *share.ends] for share in shares]).T * 100
        ends = [values[0] - values[1], values[2] - values[0]]
        axes.errorbar(values[0], methods, xerr=ends, fmt="o", markersize=3, capsize=4)
        axes.axvline(100, color=GREY, linestyle="--", linewidth=1.1)
        axes.set(title=task)
    for axes in panels[len(tasks) :]:
        axes.remove()
    for axes in panels[: len(tasks)][-2:]:  # the lowest panel of each column
        axes.tick_params(labelbottom=True)
    return finish(
        figure,
        "Share of the possible reduction (%): 0 is full braking, 100 the best known. Interquartile means over seeds"
        " with 95 % bootstrap intervals; rules have one value. Who costs more than full braking is left out.",
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", type=Path, help="files of rows (default: the committed ones)")
    parser.add_argument("--csv", type=Path, help="also write the table of all measures to this file")
    parser.add_argument("--figure", type=Path, help="also draw the figure to this file")
    args = parser.parse_args()
    try:
        for path in filter(None, (args.csv, args.figure)):
            check_target(path, force=True)
        cells = read_rows(args.rows or ROWS.glob("*.csv"))
        figure = draw(cells) if args.figure else None
        tables = [*overviews(cells), table(cells)]
        if not args.rows:
            tables += [differences(cells), held_out(cells, (ROWS / "held_out").glob("*.csv"))]
        print("\n\n".join(text_of(rows) for rows in tables if rows))
        if args.csv:
            write_file(args.csv, csv_text(table(cells)).encode())
        if figure:
            write_picture(args.figure, figure, force=True)
    except (InvalidInput, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
