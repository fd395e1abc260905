"""Where the shipped policies are at home: their training ranges, the rule of the warning, and `universal` everywhere.

    python docs/studies/competence.py record
    python docs/studies/competence.py rule runs/lines/start
    python docs/studies/competence.py warning runs/lines/start
    python docs/studies/competence.py search
    python docs/studies/competence.py table

``record`` writes the range of each shipped policy into its bundle. ``rule`` counts, for several rules, in how many
lines the rule is right that a policy is worse than a rule-based agent; no line is a shipped scenario. ``warning``
judges the chosen rule in the shipped scenarios. Both are for the policy of the three tests only, which is bad in many
lines. ``table`` writes docs/results/lines.csv, which compares agents in every shipped scenario, and in lines of 2 to 8
vehicles with each position as the learner. ``search`` adds the best known costs of lines that competence.json lacks.
All costs are honest costs, means of ``WORLDS`` worlds.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams, open_game
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.evaluation.summary import OUTSIDE_SHARE
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.policies import training_range
from ethbrake_marl.policies.bundle import load_named_policy, load_shipped, shipped_policies
from ethbrake_marl.training.training_range import record_ranges

POLICY, FALLBACK = "universal", "plan.action"
RECORDED_WORLDS, RECORDED_SEED = 4_000, 1007  # the seed is for bundles without a fixed list
WORLDS, SEED, LINES_SEED = 300, 96_001, 96_002
RULES = ((2, 0.0), (2, 0.05), (3, 0.0), (3, 0.05), (4, 0.0), (4, 0.05))  # features outside, margin
AGENTS = {name: name for name in ("full_brake", "e_v2x_bm", "plan")}
LEARNED = (POLICY, f"{POLICY}+step")
LONGEST = 8
BUDGET = 1000  # candidates in each world
BEST = Path(__file__).with_suffix(".json")  # line -> best known honest cost
TABLE = Path(__file__).parents[1] / "results" / "lines.csv"
NO_COST = 0.1  # best known costs below this (m2/s2) have no ratio
MORE, MORE_COST = 1.02, 0.05  # an agent is worse if its cost is above the other's by this factor, and this cost (m2/s2)


def record() -> None:
    from lines import mixture  # beside this file

    for name, folder in shipped_policies().items():
        policy = load_shipped(name)
        manifest = policy.manifest
        ranged = record_ranges(
            dict.fromkeys(manifest.learners, policy),
            mixture() if name == POLICY else str(manifest.scenario["name"]),
            RECORDED_WORLDS, manifest.seeds.get("evaluation", RECORDED_SEED), FALLBACK if name == POLICY else "",
        )  # fmt: skip
        next(iter(ranged.values())).save(folder / "policy", replace=True)


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
    """Shipped scenarios that `universal` can drive and a search can solve: nobody reacts to the learners."""
    loaded = [eb.load_scenario(entry.name) for entry in eb.list_scenarios()]
    exact = [scenario for scenario in loaded if scenario.learners and scenario.physics is None]
    return {scenario.name: scenario for scenario in exact if not eb.open_game(scenario)[1].scripts}


def costs(scenario: eb.Scenario, agents: Any, seed: int, measures: str = "") -> dict[str, float]:
    """Means: each agent's honest cost (``AGENT``) and numbers (``AGENT NAME``), and the share of hidden worlds."""
    result = eb.evaluate(scenario, agents, episodes=WORLDS, seed=seed, harm_count="honest", measures=measures)
    means = {agent: float(result[agent]["honest_cost"].mean()) for agent in result}
    for agent in result:
        numbers = {name: values for name, values in result[agent].items() if values.dtype.kind in "bfi"}
        means |= {f"{agent} {name}": float(values.mean()) for name, values in numbers.items()}
    return means | {"hidden": float(result.worlds["hidden"].mean())}


def both(name: str) -> dict[str, eb.LearnedAgent]:
    """A policy (name of a shipped one, or path of a run), without and with its fallback."""
    policy = load_named_policy(name)
    known = policy.manifest.training_range
    assert known is not None
    fallbacks = {"alone": "", "with the plan": FALLBACK}
    return {
        title: eb.LearnedAgent(policy.with_range(known.model_copy(update={"fallback": fallback})), title)
        for title, fallback in fallbacks.items()
    }


def is_worse(cost: float, limit: float) -> bool:
    return cost > MORE * limit + MORE_COST


def quality(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Precision and recall of the warning: is ``alone`` worse than full braking and the plan where it is outside?"""
    bad = {name for name, row in rows.items() if is_worse(row["alone"], min(row["full_brake"], row["plan"]))}
    flagged = {name for name, row in rows.items() if row["alone outside"] > OUTSIDE_SHARE}
    good, missed = len(rows) - len(bad), ", ".join(sorted(bad - flagged)) or "none"
    return f"flags {len(flagged & bad)} of {len(bad)} bad and {len(flagged - bad)} of {good} good; misses {missed}"


def rule(policy: str) -> None:
    known = {name: costs(scenario, AGENTS, LINES_SEED) for name, scenario in lines().items()}
    for features, margin in RULES:
        training_range.FEATURES_OUTSIDE, training_range.MARGIN = features, margin
        rows = {name: known[name] | costs(scenario, both(policy), LINES_SEED) for name, scenario in lines().items()}
        ratio = np.exp(np.mean([np.log(row["with the plan"] / row["plan"]) for row in rows.values()]))
        words = f"{features} features by {margin}: {quality(rows)}"
        print(f"{words}; with the plan / plan, geometric mean {ratio:.3f}", flush=True)


def warning(policy: str) -> None:
    """Print how well the warning tells where a policy is bad, and where its fallback makes a difference."""
    rows = {name: costs(scenario, AGENTS | both(policy), SEED) for name, scenario in shipped().items()}
    print(f"The warning {quality(rows)}.")
    for name, row in rows.items():
        if row["alone"] != row["with the plan"]:
            print(f"{name}: alone {row['alone']:.2f}, with the plan {row['with the plan']:.2f}")


def places() -> Iterator[tuple[str, eb.Scenario]]:
    """Lines of 2 to 8 vehicles, each with one learner."""
    for vehicles in range(2, LONGEST + 1):
        for place in range(1, vehicles + 1):
            yield f"{place} of {vehicles}", line(vehicles, place)


def search() -> None:
    """Search the least cost of the lines that ``BEST`` lacks, starting also from the agents' commands."""
    costs = json.loads(BEST.read_text())
    for name, scenario in (*shipped().items(), *places()):
        if name not in costs:
            game = open_game(scenario)[1]
            teams = make_teams(",".join((*AGENTS, POLICY)), scenario, harm_count="honest").values()
            found = search_list(
                game, scenario.sample(WORLDS, SEED), harm_counts=("honest",), budget=BUDGET, teams=teams, threads=1
            )
            costs[name] = float(found.harm["honest"].mean())
            BEST.write_text(json.dumps(costs, indent=1) + "\n")
            print(name, costs[name], flush=True)


def row_of(scenario: eb.Scenario, least: float) -> dict[str, Any]:
    """Row of the table. ``least``: best known cost of a search."""
    agents = dict.fromkeys((*AGENTS, *LEARNED))
    means = costs(scenario, {agent: agent for agent in agents}, SEED, "pushed_mps,drove_towards")
    harms = [f"total_harm_{body}" for body in scenario.learners]
    return {
        "learners": " ".join(map(str, scenario.learners)), "hidden": means["hidden"],
        **{agent: means[agent] for agent in agents},
        "best_known": min(least, *(means[agent] for agent in LEARNED)),
        **{f"{agent}_push_mps": means[f"{agent} pushed_mps"] for agent in ("e_v2x_bm", POLICY)},
        "drives": means[f"{POLICY} drove_towards"], "outside": means[f"{POLICY} outside"],
        "more_own_harm": max(means[f"{POLICY} {harm}"] - means[f"full_brake {harm}"] for harm in harms),
    }  # fmt: skip


def table() -> None:
    """Write ``TABLE``, and print a summary."""
    best, rows = json.loads(BEST.read_text()), {}
    for name, scenario in (*shipped().items(), *places()):
        rows[name] = row_of(scenario, best[name])
        print(name, rows[name], flush=True)
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["line", *next(iter(rows.values()))])
        writer.writerows(
            [name, *(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row.values())]
            for name, row in rows.items()
        )
    groups = {
        "one learner": [name for name, row in rows.items() if not row["hidden"] and " " not in row["learners"]],
        "several learners": [name for name, row in rows.items() if not row["hidden"] and " " in row["learners"]],
        "hidden values": [name for name, row in rows.items() if row["hidden"]],
    }
    print("| lines | number | agent | worse than the better rule | median | worst |")
    print("| --- | ---: | --- | --- | ---: | ---: |")
    for group, names in groups.items():
        for agent in LEARNED:
            rules = {name: min(rows[name][rule] for rule in rules_of(rows[name])) for name in names}
            worse = [name for name in names if is_worse(rows[name][agent], rules[name])]
            known = {name: rows[name]["best_known"] for name in names}
            ratios = {name: rows[name][agent] / known[name] for name in names if known[name] >= NO_COST}
            worst = max(ratios, key=lambda name: ratios[name])
            words = f"{len(worse)}{': ' if worse else ''}{', '.join(worse)}"
            middle, end = np.median([*ratios.values()]), f"{ratios[worst]:.2f} ({worst})"
            print(f"| {group} | {len(names)} | `{agent}` | {words} | {middle:.2f} | {end} |")
    extremes = {
        f"more cost, best known below {NO_COST}": {
            name: row[POLICY] - row["best_known"] for name, row in rows.items() if row["best_known"] < NO_COST
        },
        "push beyond E-V2X-BM's": {
            name: row[f"{POLICY}_push_mps"] - row["e_v2x_bm_push_mps"] for name, row in rows.items()
        },
        "driving before contact": {name: row["drives"] for name, row in rows.items()},
        "harm of a learner beyond full braking's": {name: row["more_own_harm"] for name, row in rows.items()},
    }
    for title, values in extremes.items():
        most = sorted(values, key=lambda name: -values[name])[:5]
        print(f"{title}: {', '.join(f'{name} {values[name]:.3f}' for name in most)}")


def rules_of(row: Mapping[str, Any]) -> tuple[str, str]:
    """The rules that know what the vehicle knows."""
    return ("full_brake", "plan" if row["hidden"] else "e_v2x_bm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "rule", "warning", "search", "table"))
    parser.add_argument("policy", nargs="?", help="shipped policy or run, for rule and warning only")
    given = parser.parse_args()
    judges = {"rule": rule, "warning": warning}
    if (given.what in judges) != (given.policy is not None):
        needs = "needs a policy, such as runs/lines/start" if given.what in judges else "takes no policy"
        parser.error(f"{given.what} {needs}")
    try:
        if given.what in judges:
            judges[given.what](given.policy)
        else:
            {"record": record, "search": search, "table": table}[given.what]()
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
