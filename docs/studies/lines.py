"""Rules in many lines: every shipped scenario, lines of 2 to 8 vehicles with each place as the learner, and others.

    python docs/studies/lines.py

Writes docs/results/lines.csv, and prints what the pages say of it. All costs are honest costs, means of ``WORLDS``
worlds of each line. The least known cost comes from a search that starts from the commands of the rules. Lines whose
rows are equal are one row. In the column `told`, learners tell their plans.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.search.best_harm import search_list

RULES = ("full_brake", "e_v2x_bm", "plan:1", "plan")
WORLDS, SEED = 300, 96_001
BUDGET = 1000  # candidates of the search in each world
LONGEST = 8
TABLE = Path(__file__).parents[1] / "results" / "lines.csv"
NO_COST = 0.1  # best known costs below this (m2/s2) have no ratio
MORE, MORE_COST = 1.02, 0.05  # a rule is worse if its cost is above another's by this factor, and this cost (m2/s2)
TOLD = ("place", "speed", "acceleration", "braking_capacity", "latency", "mass", "plan")


def line(vehicles: int, *learners: int, **more: Any) -> eb.Scenario:
    """A line with the vehicles of the paper's test, repeated. Vehicle 1 learns only with an obstacle ahead."""
    roles = {f"vehicle_{i}": "learner" if i in learners else "full_brake" for i in range(1, vehicles + 1)}
    repeated = {"braking_capacity_mps2": (6, 7), "driving_capacity_mps2": (6, 7), "mass_t": (4.5, 5.5, 5.9)}
    content = {
        "name": "line", "vehicles": vehicles, "roles": roles, "early_impacts": "keep", "speed_limit_mps": 40,
        "gaps_m": {"uniform": [5, 10]}, "speeds_mps": {"uniform": [18, 22]}, "restitution": 0.1,
        "latency_s": [0, *[0.5, 0.8] * 4][:vehicles],
        **{key: [values[i % len(values)] for i in range(vehicles)] for key, values in repeated.items()},
        **({"obstacle_gap_m": {"uniform": [38, 55]}} if 1 in learners else {}),
    }  # fmt: skip
    return eb.load_scenario({**content, **more})


def other_lines() -> dict[str, eb.Scenario]:
    """Lines that are no shipped scenarios: other numbers and places of learners, messages, quantities."""
    named = {f"{place} of {vehicles}": line(vehicles, place) for vehicles, place in places()}
    for place in [(3, 1, 2), (3, 2, 3), (4, 2, 3), (5, 2, 4)]:
        named[":".join(map(str, place))] = line(*place)
    for preset in ("clear", "nominal", "congested", "sensors-only"):
        named[preset] = line(3, 2, v2x=preset)
    changes: dict[str, dict[str, Any]] = {
        "near": {"gaps_m": {"uniform": [2, 5]}}, "far": {"gaps_m": {"uniform": [10, 20]}},
        "slow": {"speeds_mps": {"uniform": [9, 13]}}, "fast": {"speeds_mps": {"uniform": [26, 34]}},
        "elastic": {"restitution": 0.4}, "heavy rear": {"mass_t": [4.5, 5.5, 18]}, "heavy own": {"mass_t": [4, 15, 6]},
        "44 t behind": {"mass_t": [1.5, 1.5, 44], "braking_capacity_mps2": [8, 8, 5]},
        "late": {"latency_s": [0, 0.8, 1.2]}, "early": {"latency_s": [0, 0.2, 0.4]},
        "weak rear": {"braking_capacity_mps2": [6, 7, 4.5]}, "strong": {"braking_capacity_mps2": [8, 8, 8]},
        "build-up": {"brake_rate_mps3": 15, "release_rate_mps3": 15}, "rare decisions": {"time_step_s": 0.5},
    }  # fmt: skip
    named |= {name: line(3, 2, **change) for name, change in changes.items()}
    for place in ((3, 2), (3, 3), (4, 2), (5, 3)):
        for name, key, ends in (("near", "obstacle_margin_m", [1, 8]), ("far", "obstacle_gap_m", [38, 55])):
            named[f"{':'.join(map(str, place))}, {name} obstacle"] = line(*place, **{key: {"uniform": ends}})
    return named


def places() -> Iterator[tuple[int, int]]:
    for vehicles in range(2, LONGEST + 1):
        for place in range(1, vehicles + 1):
            yield vehicles, place


def shipped_lines() -> dict[str, eb.Scenario]:
    """Shipped scenarios with learners and exact impacts."""
    loaded = [eb.load_scenario(entry.name) for entry in eb.list_scenarios()]
    return {scenario.name: scenario for scenario in loaded if scenario.learners and scenario.physics is None}


def least_known(scenario: eb.Scenario) -> float:
    teams = make_teams(RULES, scenario).values()
    worlds = scenario.sample(WORLDS, SEED)
    found = search_list(
        eb.open_game(scenario)[1], worlds, harm_counts=("honest",), budget=BUDGET, teams=teams, threads=1
    )
    return float(found.harm["honest"].mean())


def told_cost(scenario: eb.Scenario) -> float:
    """Cost of `plan` if the learners tell their plans; NaN for one learner, and where messages lack a piece."""
    channel = scenario.v2x.model_dump(exclude_none=True)
    if len(scenario.learners) == 1 or "tells" in channel:
        return float("nan")
    telling = scenario.replace(v2x={**channel, "tells": list(TOLD)})
    result = eb.evaluate(telling, "plan", episodes=WORLDS, seed=SEED, measures="")
    return float(result["plan"]["honest_cost"].mean())


def row_of(scenario: eb.Scenario) -> dict[str, Any]:
    result = eb.evaluate(scenario, RULES, episodes=WORLDS, seed=SEED, measures="pushed_mps,drove_towards")
    means = {
        rule: {name: float(v.mean()) for name, v in result[rule].items() if v.dtype.kind in "bfi"} for rule in RULES
    }
    full, plan = result["full_brake"]["honest_cost"], result["plan"]["honest_cost"]
    costs = {rule: means[rule]["honest_cost"] for rule in RULES}
    told = told_cost(scenario)
    least = min(least_known(scenario), *costs.values(), *([told] if told == told else []))
    possible = costs["full_brake"] - least
    harms = [f"total_harm_{body}" for body in scenario.learners]
    return {
        "learners": " ".join(map(str, scenario.learners)), "hidden": float(result.worlds["hidden"].mean()), **costs,
        "told": told, "best_known": least,
        "share_of_possible": (costs["full_brake"] - costs["plan"]) / possible if possible > NO_COST else float("nan"),
        "worse_than_braking": float((plan > full + 1.0).mean()),
        "worst_5_percent": float(np.sort(plan)[-max(len(plan) // 20, 1) :].mean()),
        "push_mps": means["plan"]["pushed_mps"], "drives": means["plan"]["drove_towards"],
        "more_own_harm": max(means["plan"][harm] - means["full_brake"][harm] for harm in harms),
    }  # fmt: skip


def table() -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    for name, scenario in {**shipped_lines(), **other_lines()}.items():
        row = row_of(scenario)
        same = [known for known in rows if str(rows[known]) == str(row)]
        rows = {**{known: rows[known] for known in rows if known not in same}, " = ".join([*same, name]): row}
        print(name, {key: round(cell, 3) if isinstance(cell, float) else cell for key, cell in row.items()}, flush=True)
    return rows


def is_worse(cost: float, limit: float) -> bool:
    return cost > MORE * limit + MORE_COST


def summarise(rows: dict[str, dict[str, Any]]) -> None:
    groups = {
        "one learner that hears": [
            name for name, row in rows.items() if not row["hidden"] and " " not in row["learners"]
        ],
        "several learners": [name for name, row in rows.items() if not row["hidden"] and " " in row["learners"]],
        "hidden values": [name for name, row in rows.items() if row["hidden"]],
    }
    for group, names in groups.items():
        better = ("full_brake", "plan:1") if group == "hidden values" else ("full_brake", "e_v2x_bm")
        for column in ("plan", *(["told"] if group == "several learners" else [])):
            known = {name: row for name, row in rows.items() if name in names and row[column] == row[column]}
            worse = [name for name, row in known.items() if is_worse(row[column], min(row[rule] for rule in better))]
            won = [
                name for name, row in known.items() if row["best_known"] > NO_COST and row["share_of_possible"] > 0.0
            ]
            ratios = {name: known[name][column] / known[name]["best_known"] for name in won}
            worst = max(ratios, key=lambda name: ratios[name])
            print(
                f"{group}, {column}: {len(known)} lines; worse than the better of {' and '.join(better)}: {worse or 'none'};"
                f" cost / best known in {len(won)}: median {np.median([*ratios.values()]):.3f}, most {ratios[worst]:.3f} ({worst})"
            )
    for column in ("worse_than_braking", "push_mps", "drives", "more_own_harm"):
        most = sorted(rows, key=lambda name: -rows[name][column])[:5]
        print(f"{column}: {', '.join(f'{name} {rows[name][column]:.3f}' for name in most)}")


def main() -> None:
    rows = table()
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["line", *next(iter(rows.values()))])
        for name, row in rows.items():
            writer.writerow([name, *(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row.values())])
    summarise(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    try:
        main()
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
