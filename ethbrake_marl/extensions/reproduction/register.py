"""The register: what the paper leaves open, our default, and what the random test gives with another value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ethbrake_marl.evaluation.door import SEED
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.extensions.report.paper_rows import RANDOM_TEST
from ethbrake_marl.extensions.reproduction.made import POLICIES, Made, Settings
from ethbrake_marl.extensions.reproduction.readings import COUPLED, FOUR, NON_ETHICAL, PPO, RANDOM, REALISED, drive
from ethbrake_marl.extensions.reproduction.verdicts import PERCENT, Verdict, compare_number
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.progress import Progress
from ethbrake_marl.worlds.catalogue import load_scenario

WORLDS = 2_000
SHOWN = (NON_ETHICAL, REALISED, COUPLED, PPO)


@dataclass(frozen=True)
class Alternative:
    """Another value of a quantity."""

    value: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # keys of the scenario
    seed: int = SEED
    count: str = "first_impact"  # ``total``, or ``predicted``: what E-V2X-BM expects
    ppo: str = FOUR[PPO]  # what drives as PPO


@dataclass(frozen=True)
class Gap:
    """A quantity that the paper does not state, or not clearly."""

    name: str
    paper: str  # what it says, with the label in its source
    ours: str  # our default
    alternatives: tuple[Alternative, ...] = ()
    otherwise: str = ""  # why there are none


def _of(key: str, *values: float, unit: str = "") -> tuple[Alternative, ...]:
    return tuple(Alternative(f"{value:g}{unit}", {key: value}) for value in values)


GAPS = (
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        _of("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("time step Δt", "sec:optimization_problem: a sampling period, no number", "0.1 s",
        _of("time_step_s", 0.05, 0.2, unit=" s between decisions")),
    Gap("impacts at samples or exact", "dynamics2: at samples", "at their exact time; each impact once",
        otherwise="in the scenario paper-random-map, which E-V2X-BM (coupled) does not know"),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", _of("horizon_s", 5.0, 16.0, unit=" s")),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", _of("speed_limit_mps", 25.0, unit=" m/s")),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s",
        (Alternative("0.2 s", {"latency_s": [0, 0.2, 0.8]}), Alternative("0.3 s", {"latency_s": [0, 0.3, 0.8]}))),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0",
        (Alternative("from τ2 (τ3 = 1.3 s)", {"latency_s": [0, 0.5, 1.3]}),)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", (Alternative("every impact", count="total"),)),
    Gap("H* of E-V2X-BM, predicted or realised", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        (Alternative("predicted, pair by pair", count="predicted"),)),
    Gap("H* inside the hybrid", "alg:hybrid: H* of Eq:BaselineHarm", "realised (coupled)",
        (Alternative("hybrid with realised H*", ppo="ppo+episode"),
         Alternative("hybrid with predicted H*", ppo="ppo+episode:pairwise"))),
    Gap("initial speeds of Table:hybrid", "identical simulation settings; only gaps are named", "18 to 22 m/s",
        (Alternative("20, 18, 20 m/s", {"speeds_mps": [20, 18, 20]}),)),
    Gap("seed of the test", "text to Table:hybrid: a fixed random seed", "7",
        (Alternative("8", seed=8), Alternative("9", seed=9))),
    Gap("impacts before Vehicle 2 may act", "sec:system_model: assumed not to happen", "such worlds are drawn again",
        (Alternative("kept", {"early_impacts": "keep"}),)),
    Gap("what Vehicle 1 brakes for", "sec:problem: an unforeseen obstacle, not modelled", "nothing ahead",
        (Alternative("an obstacle 1.7 m beyond its stopping point", {"obstacle_margin_m": 1.7}),)),
    Gap("may Vehicle 2 drive", "text to Fig:Harm-ivds: yes, a_u,2 = 7 m/s²; E-V2X-BM only brakes", "yes",
        (Alternative("no, brake and coast only", {"driving_capacity_mps2": [6, 0, 6]}),)),
    Gap("Vehicles 1 and 3 after an impact", "eq:olle1, eq:olle2: brake for a time fixed by the initial speeds",
        "brake until they stand",
        otherwise="not measured: the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", otherwise="not measured: each needs trainings that converge"),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features",
        otherwise="not measured: it needs trainings that converge"),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        otherwise="--full trains three"),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        otherwise="not measured: one training each takes minutes; docs/train.md compares recipes"),
)  # fmt: skip
DEFAULTS = Gap("our defaults", "", "")


def measure(alternative: Alternative, episodes: int) -> tuple[Result, dict[str, Floats]]:
    """Drive the random test with another value; return the harm of each strategy, [n] m2/s2, beside the result.

    What predicts nothing has its first-impact harm in place of the predicted one.
    """
    scenario = load_scenario(RANDOM).replace(**alternative.changes)
    agents = {name: FOUR[name] for name in SHOWN} | {PPO: alternative.ppo}
    result = drive(scenario, agents, episodes, alternative.seed)
    harm = {}
    for name, columns in result.columns.items():
        harm[name] = columns.get(f"{alternative.count}_harm", columns["first_impact_harm"])
    return result, harm


def reproduce_gaps(settings: Settings) -> Made:
    """Measure every alternative of the register."""
    episodes = min(WORLDS, settings.episodes)
    asked = [(DEFAULTS, Alternative("")), *((gap, each) for gap in GAPS for each in gap.alternatives)]
    rows, harms = [], dict[str, dict[str, Floats]]()
    for number, (gap, each) in enumerate(asked):
        settings.tell(Progress("open quantities", number, len(asked)))
        result, harm = measure(each, episodes)
        harms[f"{gap.name}: {each.value}"] = harm
        rates = (rate(columns["collided"]).value for columns in result.columns.values())
        rows.append((gap.name, each.value, *map(mean, harm.values()), *rates))
    base, *others = harms.values()
    printed = {row.agent: row.average_harm for row in RANDOM_TEST}
    verdicts = [
        compare_number(
            f"{agent}, average harm of Table:Random, one open quantity changed at a time",
            printed[agent],
            mean(base[name]),
            others={row: mean(harm[name]) for row, harm in harms.items() if harm is not base},
        )
        for agent, name in (("Non-E", NON_ETHICAL), ("E-V2X-BM", REALISED), ("Hybrid PPO", PPO))
    ]
    broken = [
        row
        for row, harm in harms.items()
        if harm is not base and not harm[PPO].mean() <= harm[COUPLED].mean() <= harm[NON_ETHICAL].mean()
    ]
    stays = f"in {len(others) - len(broken)} of {len(others)} alternatives"
    verdicts.append(
        Verdict(
            f"the order stays: {PPO} < {COUPLED} < {NON_ETHICAL}",
            "differs" if broken else "agrees",
            f"{stays}; not with {'; '.join(broken)}" if broken else stays,
        )
    )
    register = [
        (gap.name, gap.paper, gap.ours, "; ".join(each.value for each in gap.alternatives) or gap.otherwise)
        for gap in GAPS
    ]
    collisions = [replace(PERCENT, heading=f"Collisions, {name}") for name in SHOWN]
    note = (
        f"{episodes:,} worlds. Mean harm (m²/s²) with its 95 % interval, then the collision rate. In the rows of H*"
        f" inside the hybrid, PPO stands behind Algorithm 1. {POLICIES} They are not trained anew for an alternative."
    )
    sheets = [
        Sheet(
            "Register of what the paper leaves open",
            ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured"),
            register,
            "Labels are those of the paper's source.",
        ),
        Sheet("The random test with other values", ("Quantity", "Value", *map(Column, SHOWN), *collisions), rows, note),
    ]
    return Made(verdicts, sheets)
