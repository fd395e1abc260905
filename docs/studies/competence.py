"""Where the shipped policies are at home: their training ranges, the rule of the warning, and `universal` everywhere.

    python docs/studies/competence.py record
    python docs/studies/competence.py rule
    python docs/studies/competence.py table

``record`` writes the range of each shipped policy into its bundle, from the fixed list of its training. ``rule``
counts, for several rules, in how many lines the rule is right that ``universal`` alone is worse than a rule-based
agent; no line is a shipped scenario. ``table`` compares agents in every shipped scenario, and judges the rule there.
All costs are honest costs, means of ``WORLDS`` worlds.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.summary_row import OUTSIDE_SHARE
from ethbrake_marl.policies import training_range
from ethbrake_marl.policies.bundle import load_shipped, shipped_policies
from ethbrake_marl.training.training_range import record_ranges

POLICY, FALLBACK = "universal", "plan.action"
RECORDED_WORLDS, RECORDED_SEED = 4_000, 1007  # the seed is for bundles without a fixed list
WORLDS, SEED, LINES_SEED = 300, 96_001, 96_002
RULES = ((2, 0.0), (2, 0.05), (3, 0.0), (3, 0.05), (4, 0.0), (4, 0.05))  # features outside, margin
AGENTS = {name: name for name in ("full_brake", "e_v2x_bm", "plan")}
MORE, MORE_COST = 1.02, 0.05  # an agent is worse if its cost is above the other's by this factor, and this cost (m2/s2)


def record() -> None:
    for name, folder in shipped_policies().items():
        policy = load_shipped(name)
        manifest = policy.manifest
        ranged = record_ranges(
            dict.fromkeys(manifest.learners, policy), str(manifest.scenario["name"]), RECORDED_WORLDS,
            manifest.seeds.get("evaluation", RECORDED_SEED), FALLBACK if name == POLICY else "",
        )  # fmt: skip
        next(iter(ranged.values())).save(folder / "policy", replace=True)


def line(vehicles: int, *learners: int, **more: Any) -> eb.Scenario:
    """A line with the vehicles of the paper's test, repeated. Vehicle 1 learns only with an obstacle ahead."""
    roles = {f"vehicle_{i}": "learner" if i in learners else "full_brake" for i in range(1, vehicles + 1)}
    repeated = {"braking_capacity_mps2": (6, 7), "driving_capacity_mps2": (6, 7), "mass_t": (4.5, 5.5, 5.9)}
    content = {
        "name": "line", "vehicles": vehicles, "roles": roles, "early_impacts": "keep", "speed_limit_mps": 40,
        "gaps_m": {"uniform": [5, 10]}, "speeds_mps": {"uniform": [18, 22]}, "restitution": 0.1,
        "latency_s": [0, 0.5, 0.8, 0.5, 0.8, 0.5][:vehicles],
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


def costs(scenario: eb.Scenario, agents: Any, seed: int) -> dict[str, float]:
    """Honest cost of each agent, its share of decisions outside (``NAME outside``), and the share of hidden worlds."""
    result = eb.evaluate(scenario, agents, episodes=WORLDS, seed=seed, harm_count="honest")
    ranged = [agent for agent in result if "outside" in result[agent]]
    means = {agent: float(result[agent]["honest_cost"].mean()) for agent in result}
    means |= {f"{agent} outside": float(result[agent]["outside"].mean()) for agent in ranged}
    return means | {"hidden": float(result.worlds["hidden"].mean())}


def alone() -> eb.LearnedAgent:
    """The policy without its fallback."""
    policy = load_shipped(POLICY)
    known = policy.manifest.training_range
    return eb.LearnedAgent(policy.with_range(known and known.model_copy(update={"fallback": ""})), "alone")


def is_worse(cost: float, limit: float) -> bool:
    return cost > MORE * limit + MORE_COST


def quality(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Precision and recall of the warning: is ``alone`` worse than full braking and the plan where it is outside?"""
    bad = {name for name, row in rows.items() if is_worse(row["alone"], min(row["full_brake"], row["plan"]))}
    flagged = {name for name, row in rows.items() if row["alone outside"] > OUTSIDE_SHARE}
    good, missed = len(rows) - len(bad), ", ".join(sorted(bad - flagged)) or "none"
    return f"flags {len(flagged & bad)} of {len(bad)} bad and {len(flagged - bad)} of {good} good; misses {missed}"


def rule() -> None:
    known = {name: costs(scenario, AGENTS, LINES_SEED) for name, scenario in lines().items()}
    for features, margin in RULES:
        training_range.FEATURES_OUTSIDE, training_range.MARGIN = features, margin
        agents = {"alone": alone(), POLICY: POLICY}
        rows = {name: known[name] | costs(scenario, agents, LINES_SEED) for name, scenario in lines().items()}
        ratio = np.exp(np.mean([np.log(row[POLICY] / row["plan"]) for row in rows.values()]))
        print(
            f"{features} features by {margin}: {quality(rows)}; {POLICY} / plan, geometric mean {ratio:.3f}", flush=True
        )


def table() -> None:
    """Print a Markdown table of all shipped scenarios, and those that remain worse than the better rule."""
    agents = {**AGENTS, "alone": alone(), POLICY: POLICY, f"{POLICY}+step": f"{POLICY}+step"}
    rows, remaining = {}, []
    print(f"| scenario | {' | '.join(agents)} | outside |\n| --- |{' ---: |' * (len(agents) + 1)}")
    for entry in eb.list_scenarios():
        scenario = eb.load_scenario(entry.name)
        if not scenario.learners or scenario.physics is not None:
            continue
        rows[entry.name] = row = costs(scenario, agents, SEED)
        rival = "plan" if row["hidden"] else "e_v2x_bm"
        if is_worse(row[POLICY], min(row["full_brake"], row[rival])):
            remaining.append(entry.name)
        cells = [f"{row[agent]:.2f}" for agent in agents] + [f"{100 * row[f'{POLICY} outside']:.0f} %"]
        print(f"| `{entry.name}`{' †' if row['hidden'] else ''} | {' | '.join(cells)} |", flush=True)
    print(f"\nThe warning {quality(rows)}.\nWorse than the better rule: {', '.join(remaining) or 'none'}.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "rule", "table"))
    {"record": record, "rule": rule, "table": table}[parser.parse_args().what]()
