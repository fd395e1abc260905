"""Where agents are at home: the rule of the warning of policies outside their training, and `plan` in every line.

    python docs/studies/competence.py rule runs/three-tests
    python docs/studies/competence.py warning runs/three-tests
    python docs/studies/competence.py search
    python docs/studies/competence.py table

``rule`` counts, for several rules, in how many lines the rule is right that a policy is worse than a rule-based agent;
no line is a shipped scenario. ``warning`` judges the chosen rule in the shipped scenarios. Both are for a policy of the
recipe ``three-tests`` only, which is bad in many lines. ``table`` writes docs/results/lines.csv, which compares agents
in every shipped scenario, in lines of 2 to 8 vehicles with each position as the learner, and in 39 others, and prints
the table of docs/findings.md. ``search`` searches the best known costs in competence.json again. All costs are honest
costs, means of ``WORLDS`` worlds.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams, open_game
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.evaluation.summary import OUTSIDE_SHARE
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.policies import training_range
from ethbrake_marl.policies.bundle import load_named_policy

WORLDS, SEED, LINES_SEED = 300, 96_001, 96_002
RULES = ((2, 0.0), (2, 0.05), (3, 0.0), (3, 0.05), (4, 0.0), (4, 0.05))  # features outside, margin
CONSTANT = "plan:1"
RIVALS = ("full_brake", "e_v2x_bm", CONSTANT)
AGENT = "plan"
LONGEST = 8
BUDGET = 1000  # candidates in each world
BEST = Path(__file__).with_suffix(".json")  # line -> best known honest cost
TABLE = Path(__file__).parents[1] / "results" / "lines.csv"
NO_COST, NO_GAIN = 0.1, 1.01  # best known costs below this (m2/s2), or by less than this factor below full braking's
MORE, MORE_COST = 1.02, 0.05  # an agent is worse if its cost is above the other's by this factor, and this cost (m2/s2)
TOLD = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass", "plan"]
GROUPS = ("one learner", "several learners", "the channel hides values")


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


def lines() -> dict[str, eb.Scenario]:
    """Lines that are no shipped scenarios: other numbers, places and numbers of learners, messages, quantities."""
    places = [(2, 1), (2, 2), (3, 1), (3, 3), (4, 2), (4, 3), (4, 4), (5, 2), (5, 4), (6, 3), (3, 1, 2), (3, 2, 3)]
    named = {":".join(map(str, place)): line(*place) for place in [*places, (4, 2, 3), (5, 2, 4)]}
    for preset in ("clear", "nominal", "congested", "sensors-only"):
        named[preset] = line(3, 2, v2x=preset)
    changes: dict[str, dict[str, Any]] = {
        "near": {"gaps_m": {"uniform": [2, 5]}}, "far": {"gaps_m": {"uniform": [10, 20]}},
        "slow": {"speeds_mps": {"uniform": [9, 13]}}, "fast": {"speeds_mps": {"uniform": [26, 34]}},
        "elastic": {"restitution": 0.4}, "heavy rear": {"mass_t": [4.5, 5.5, 18]}, "heavy own": {"mass_t": [4, 15, 6]},
        "late": {"latency_s": [0, 0.8, 1.2]}, "early": {"latency_s": [0, 0.2, 0.4]},
        "weak rear": {"braking_capacity_mps2": [6, 7, 4.5]}, "strong": {"braking_capacity_mps2": [8, 8, 8]},
        "build-up": {"brake_rate_mps3": 15, "release_rate_mps3": 15},
        "slightly other": {"gaps_m": {"uniform": [4.5, 11]}, "mass_t": [4.4, 5.6, 6.1], "latency_s": [0, 0.45, 0.85]},
    }  # fmt: skip
    named |= {name: line(3, 2, **change) for name, change in changes.items()}
    for place in ((3, 2), (3, 3), (4, 2), (5, 3)):
        for name, key, ends in (("near", "obstacle_margin_m", [1, 8]), ("far", "obstacle_gap_m", [38, 55])):
            named[f"{':'.join(map(str, place))}, {name} obstacle"] = line(*place, **{key: {"uniform": ends}})
    return named


def shipped() -> dict[str, eb.Scenario]:
    """Shipped scenarios with exact impacts and a learner to whom nobody reacts."""
    loaded = [eb.load_scenario(entry.name) for entry in eb.list_scenarios()]
    exact = [scenario for scenario in loaded if scenario.learners and scenario.physics is None]
    return {scenario.name: scenario for scenario in exact if not eb.open_game(scenario)[1].scripts}


def costs(scenario: eb.Scenario, agents: Any, seed: int) -> dict[str, float]:
    """Means: each agent's honest cost (``AGENT``) and numbers (``AGENT NAME``)."""
    result = eb.evaluate(scenario, agents, episodes=WORLDS, seed=seed, harm_count="honest")
    means = {agent: float(result[agent]["honest_cost"].mean()) for agent in result}
    for agent in result:
        numbers = {name: values for name, values in result[agent].items() if values.dtype.kind in "bfi"}
        means |= {f"{agent} {name}": float(values.mean()) for name, values in numbers.items()}
    return means


def is_worse(cost: float, limit: float) -> bool:
    return cost > MORE * limit + MORE_COST


def quality(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Precision and recall of the warning: is the policy worse than full braking and a plan where it is outside?"""
    bad = {name for name, row in rows.items() if is_worse(row["policy"], min(row["full_brake"], row[CONSTANT]))}
    flagged = {name for name, row in rows.items() if row["policy outside"] > OUTSIDE_SHARE}
    good, missed = len(rows) - len(bad), ", ".join(sorted(bad - flagged)) or "none"
    return f"flags {len(flagged & bad)} of {len(bad)} bad and {len(flagged - bad)} of {good} good; misses {missed}"


def compared(policy: str) -> dict[str, Any]:
    """Agents by name; ``policy``: name of a shipped policy, or path of a run."""
    return {**{name: name for name in RIVALS}, "policy": eb.LearnedAgent(load_named_policy(policy), "policy")}


def rule(policy: str) -> None:
    for features, margin in RULES:
        training_range.FEATURES_OUTSIDE, training_range.MARGIN = features, margin
        rows = {name: costs(scenario, compared(policy), LINES_SEED) for name, scenario in lines().items()}
        print(f"{features} features by {margin}: {quality(rows)}", flush=True)


def warning(policy: str) -> None:
    """Print how well the warning tells where a policy is bad."""
    rows = {name: costs(scenario, compared(policy), SEED) for name, scenario in shipped().items()}
    print(f"The warning {quality(rows)}.")


def places() -> Iterator[tuple[str, eb.Scenario]]:
    """Lines of 2 to 8 vehicles, each with one learner."""
    for vehicles in range(2, LONGEST + 1):
        for place in range(1, vehicles + 1):
            yield f"{place} of {vehicles}", line(vehicles, place)


def telling() -> Iterator[tuple[str, eb.Scenario]]:
    """Shipped lines of several learners, who also tell their plans."""
    for name, scenario in shipped().items():
        channel = scenario.v2x.model_dump(exclude_none=True)
        if len(scenario.learners) > 1 and "tells" not in channel:
            yield f"{name}, plans told", scenario.replace(v2x={**channel, "tells": TOLD})


def every_line() -> dict[str, eb.Scenario]:
    return {**shipped(), **dict(telling()), **dict(places()), **lines()}


def search() -> None:
    """Search the best known costs again, starting also from the agents' commands. The less of old and new cost stays.

    Lines whose worlds and learners are the same have one cost.
    """
    known, tables = json.loads(BEST.read_text()), dict[bytes, BestHarmTable]()
    alike: dict[bytes, list[str]] = {}
    for name, scenario in every_line().items():
        game, worlds = open_game(scenario)[1], scenario.sample(WORLDS, SEED)
        key = problem_of(game, worlds).identity.tobytes()
        tables[key] = search_list(
            game, worlds, harm_counts=("honest",), budget=BUDGET, threads=1, known_table=tables.get(key),
            teams=make_teams(",".join((*RIVALS, AGENT)), scenario, harm_count="honest").values(),
        )  # fmt: skip
        alike.setdefault(key, []).append(name)
        cost = min([float(tables[key].harm["honest"].mean()), *(known[each] for each in alike[key] if each in known)])
        print(name, known.get(name), cost, flush=True)
        known |= dict.fromkeys(alike[key], cost)
        BEST.write_text(json.dumps(known, indent=1) + "\n")


def row_of(scenario: eb.Scenario, least: float) -> dict[str, Any]:
    """Row of the table. ``least``: best known cost of a search."""
    result = eb.evaluate(
        scenario, [*RIVALS, AGENT], episodes=WORLDS, seed=SEED, harm_count="honest", measures="pushed_mps,drove_towards"
    )
    means = {agent: {name: float(np.mean(values)) for name, values in result[agent].items()
                     if values.dtype.kind in "bfi"} for agent in result}  # fmt: skip
    worst = WORLDS // 20
    braking, planned = result["full_brake"]["honest_cost"], result[AGENT]["honest_cost"]
    harms = [f"total_harm_{body}" for body in scenario.learners]
    return {
        "learners": " ".join(map(str, scenario.learners)), "hidden": float(result.worlds["hidden"].mean()),
        **{agent: means[agent]["honest_cost"] for agent in result},
        "best_known": min(least, *(means[agent]["honest_cost"] for agent in result)),
        "over_1": float((planned > braking + 1.0).mean()),
        "worst5": float(np.sort(planned)[-worst:].mean()), "full_brake_worst5": float(np.sort(braking)[-worst:].mean()),
        **{f"{agent}_push_mps": means[agent]["pushed_mps"] for agent in ("e_v2x_bm", AGENT)},
        "drives": means[AGENT]["drove_towards"],
        "more_own_harm": max(means[AGENT][harm] - means["full_brake"][harm] for harm in harms),
    }  # fmt: skip


def table() -> None:
    """Write ``TABLE``, and print the table of the page. Lines in which all agents cost the same are one line."""
    best, rows = json.loads(BEST.read_text()), {}
    for name, scenario in every_line().items():
        row = row_of(scenario, best[name])
        if not any(all(shown(row[each]) == shown(other[each]) for each in (*RIVALS, AGENT)) for other in rows.values()):
            rows[name] = row
        print(name, row, flush=True)
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["line", *next(iter(rows.values()))])
        writer.writerows([name, *(shown(cell) for cell in row.values())] for name, row in rows.items())
    for cells in page_rows(read_table()):
        print(f"| {' | '.join(cells)} |")


def shown(cell: float | str) -> str:
    return f"{cell:.4g}" if isinstance(cell, float) else cell


def read_table() -> list[dict[str, str]]:
    return list(csv.DictReader(TABLE.read_text("utf-8").splitlines()))


def page_rows(table: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Rows of the table in docs/findings.md."""
    found = []
    for group in GROUPS:
        rows = {row["line"]: row for row in table if group_of(row) == group}
        numbers = {
            name: {key: float(cell) for key, cell in row.items() if key not in ("line", "learners")}
            for name, row in rows.items()
        }
        worse = [name for name, row in numbers.items() if is_worse(row[AGENT], min(row[rival] for rival in known(row)))]
        ratios = {
            name: row[AGENT] / row["best_known"]
            for name, row in numbers.items()
            if row["best_known"] >= NO_COST and row["full_brake"] > NO_GAIN * row["best_known"]
        }
        worst, over = max(ratios, key=lambda name: ratios[name]), max(numbers, key=lambda name: numbers[name]["over_1"])
        found.append([
            group, str(len(rows)), f"{len(worse)}{': ' if worse else ''}{', '.join(f'`{name}`' for name in worse)}",
            f"{np.median([*ratios.values()]):.2f}", f"{ratios[worst]:.2f} (`{worst}`)",
            f"{100.0 * numbers[over]['over_1']:.1f} % (`{over}`)",
        ])  # fmt: skip
    return found


def group_of(row: Mapping[str, str]) -> str:
    if float(row["hidden"]):
        return GROUPS[2]
    return GROUPS[1] if " " in row["learners"] else GROUPS[0]


def known(row: Mapping[str, float]) -> tuple[str, str]:
    """The rules that know what the vehicle knows."""
    return ("full_brake", CONSTANT if row["hidden"] else "e_v2x_bm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("rule", "warning", "search", "table"))
    parser.add_argument("policy", nargs="?", help="shipped policy or run, for rule and warning only")
    given = parser.parse_args()
    judges = {"rule": rule, "warning": warning}
    if (given.what in judges) != (given.policy is not None):
        needs = "needs a policy, such as runs/three-tests" if given.what in judges else "takes no policy"
        parser.error(f"{given.what} {needs}")
    try:
        if given.what in judges:
            judges[given.what](given.policy)
        else:
            {"search": search, "table": table}[given.what]()
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
