"""Where the shipped policies are at home: their training ranges, the rule of the warning, and `universal` everywhere.

    python docs/studies/competence.py record
    python docs/studies/competence.py rule runs/lines/start
    python docs/studies/competence.py warning runs/lines/start
    python docs/studies/competence.py table

``record`` writes the range of each shipped policy into its bundle. ``rule`` counts, for several rules, in how many
lines the rule is right that a policy is worse than a rule-based agent; no line is a shipped scenario. ``warning``
judges the chosen rule in the shipped scenarios. Both are for the policy of one test only, which is bad in many lines.
``table`` compares agents in every shipped scenario, and in lines of 2 to 8 vehicles with each position as the learner
(20 minutes of processor time). All costs are honest costs, means of ``WORLDS`` worlds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.summary_row import OUTSIDE_SHARE
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.names import make_teams, open_game
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
    """Shipped scenarios that `universal` can drive."""
    loaded = [eb.load_scenario(entry.name) for entry in eb.list_scenarios()]
    return {scenario.name: scenario for scenario in loaded if scenario.learners and scenario.physics is None}


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


def best_known(scenario: eb.Scenario) -> float:
    """Least mean cost that a search finds; it also starts from the commands of the agents."""
    game = open_game(scenario)[1]
    teams = make_teams(",".join((*AGENTS, *LEARNED)), scenario, harm_count="honest").values()
    found = search_list(game, scenario.sample(WORLDS, SEED), counts=("honest",), teams=teams, threads=1)
    return float(found.harm["honest"].mean())


def places() -> Iterator[tuple[str, eb.Scenario]]:
    """Lines of 2 to 8 vehicles, each with one learner."""
    for vehicles in range(2, LONGEST + 1):
        for place in range(1, vehicles + 1):
            yield f"{place} of {vehicles}", line(vehicles, place)


def own_harm(scenario: eb.Scenario, row: Mapping[str, float]) -> str:
    """Learners that bear more harm than under full braking, and how much more (m2/s2)."""
    names = {i: f"total_harm_{i}" for i in scenario.learners}
    more = {i: row[f"{POLICY} {name}"] - row[f"full_brake {name}"] for i, name in names.items()}
    return ", ".join(f"{i}: +{extra:.1f}" for i, extra in more.items() if extra > MORE_COST)


def table() -> None:
    """Print a Markdown table, and summaries."""
    agents = dict.fromkeys((*AGENTS, *LEARNED))
    print("| line | full braking | E-V2X-BM | plan | `universal` | `+step` | best known | push | drives | own harm |")
    print("| --- |" + " ---: |" * 9)
    ratios: dict[bool, dict[str, float]] = {False: {}, True: {}}
    worse, over = {agent: [] for agent in LEARNED}, []
    for name, scenario in (*shipped().items(), *places()):
        row = costs(scenario, {agent: agent for agent in agents}, SEED, "pushed_mps,drove_towards")
        least = best_known(scenario)
        rival = min(row["full_brake"], row["plan" if row["hidden"] else "e_v2x_bm"])
        for agent in LEARNED:
            worse[agent] += [name] if is_worse(row[agent], rival) else []
        if not row["hidden"] and least >= NO_COST:
            ratios[len(scenario.learners) > 1][name] = row[POLICY] / least
        elif not row["hidden"] and row[POLICY] > least + NO_COST:
            over.append(name)
        numbers = [row["full_brake"], row["e_v2x_bm"], row["plan"], row[POLICY], row[f"{POLICY}+step"], least]
        cells = [f"`{name}`" if scenario.name == name else name]
        cells[0] += " †" if row["hidden"] else ""
        cells += [f"{number:.2f}" for number in numbers] + [f"{row[f'{POLICY} pushed_mps']:.2f}"]
        cells += [f"{row[f'{POLICY} drove_towards']:.1%}", own_harm(scenario, row)]
        print(f"| {' | '.join(cells)} |", flush=True)
    for agent, names in worse.items():
        print(f"\n{agent} is worse than the better rule: {', '.join(names) or 'nowhere'}.")
    for several, rows in ratios.items():
        worst = max(rows, key=lambda name: rows[name])
        who = "several learners" if several else "one learner"
        print(f"{who}: median {np.median([*rows.values()]):.3f} times best known, worst {rows[worst]:.3f} ({worst}).")
    print(f"Best known below {NO_COST}, and more than {NO_COST} above it: {', '.join(over) or 'nowhere'}.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "rule", "warning", "table"))
    parser.add_argument("policy", nargs="?", default=POLICY, help="shipped policy or run, for rule and warning")
    given = parser.parse_args()
    if given.what in ("rule", "warning"):
        {"rule": rule, "warning": warning}[given.what](given.policy)
    else:
        {"record": record, "table": table}[given.what]()
