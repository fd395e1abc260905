"""The register: each quantity that the paper leaves open, our default, and the random test with other values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.extensions.reproduction.made import DRIVERS, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.paper_rows import RANDOM_TEST
from ethbrake_marl.extensions.reproduction.random_test import PAPER_ROWS, RandomTable, table_of
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED, Reading
from ethbrake_marl.extensions.reproduction.verdicts import PERCENT
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.progress import Progress

REGISTER_WORLDS = 2_000
PRINTED = np.array([(row.collision_rate, row.average_harm) for row in RANDOM_TEST])  # [4, 2]


class Gap(NamedTuple):
    name: str
    paper: str  # what it says, with the label in its source
    ours: str  # our default
    alternatives: tuple[Reading, ...] = ()
    otherwise: str = ""  # why there are none


def vary(field: str, *values: Any) -> tuple[Reading, ...]:
    return tuple(STATED._replace(**{field: value}) for value in values)


def key(name: str, *values: Any) -> tuple[Reading, ...]:
    return tuple(STATED._replace(others=((name, value),)) for value in values)


EARLY_DRIVEN = STATED._replace(acts_s=0.2, plans_as_stated=True, baseline="predicted harm, realised collisions")

GAPS = (
    Gap("impacts at samples or exact, time step Δt", "dynamics2: at samples; a sampling period, no number",
        "at their exact time; a decision every 0.1 s",
        (*vary("step_s", 0.1, 0.2, 0.25, 0.5), *key("time_step_s", 0.05, 0.2))),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s", vary("acts_s", 0.3, 0.2)),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0; 1.3 s: from τ2",
        vary("rear_s", 0.95, 1.3)),
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        vary("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", vary("counted", "total")),
    Gap("the non-ethical vehicles after an impact", "text to Fig:Harm-ivds: brake until standstill or collision",
        "brake until they stand", vary("after_impact", "coasts", "ends")),
    Gap("for which latencies E-V2X-BM plans", "sec:result: those of the test", "those that are driven",
        (EARLY_DRIVEN, EARLY_DRIVEN._replace(star="low end"), EARLY_DRIVEN._replace(star="high end"))),
    Gap("which a*", "Eq:BaselineHarm: any of an interval, if H* = 0", "the middle",
        otherwise="no effect, unless other latencies are driven than planned for: see above"),
    Gap("what is reported of E-V2X-BM", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        vary("baseline", "predicted")),
    Gap("H* inside the hybrid, and what is reported", "alg:hybrid: H* of Eq:BaselineHarm, expects min(H_RL, H*)",
        "the pairwise H*, realised", vary("hybrid", "predicted", "realised, by the coupled H*", "policy alone")),
    Gap("may Vehicle 2 drive", "text to Fig:Harm-ivds: yes, a_u,2 = 7 m/s²; E-V2X-BM only brakes", "yes",
        key("driving_capacity_mps2", (6.0, 0.0, 6.0))),
    Gap("what Vehicle 1 brakes for", "sec:problem: an unforeseen obstacle, not modelled", "nothing ahead",
        key("obstacle_margin_m", 1.7)),
    Gap("initial speeds of Table:hybrid", "identical simulation settings; only gaps are named", "18 to 22 m/s",
        key("speeds_mps", (20.0, 18.0, 20.0))),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", otherwise="no effect on any number, from 5 to 16 s"),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", otherwise="no effect on any number, from 25 m/s"),
    Gap("seed of the test", "text to Table:hybrid: a fixed random seed", "7", vary("seed", 8, 9)),
    Gap("impacts before Vehicle 2 may act", "sec:system_model: assumed not to happen", "such worlds are drawn again",
        otherwise="no effect: no world of the random test has one"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", otherwise="each needs trainings: docs/paper.md has some"),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features",
        otherwise="--full trains ppo-paper and sac-paper, which observe the paper's state"),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0 to 4",
        otherwise="--full trains five, and three for each learning curve"),
    Gap("delays of the learning curves and of Fig:harm-delay", "captions: high, low; our source has no figures",
        "0.1, 0.3 s; 0.3, 0.6 s; 0.8, 1.2 s", otherwise="not measured: learning curves need other trainings"),
    Gap("where the training for Table:hybrid stopped", "before convergence occurred", "a fifteenth of the recipe ppo",
        otherwise="not measured: one stop only"),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        otherwise="not measured: one training each takes minutes; docs/train.md has recipes"),
)  # fmt: skip
DEFAULTS = Gap("our defaults", "", "")
COMBINED = Gap("several at once", "", "", (
    EARLY_DRIVEN._replace(star="low end", hybrid="predicted"),
    STATED._replace(acts_s=0.2, step_s=0.2),
    STATED._replace(rear_s=0.95, step_s=0.2),
    NEAREST,
))  # fmt: skip


def rates_and_harms(table: RandomTable) -> Floats:
    """Collision rates and mean harms (m2/s2) of the four strategies, [4, 2]."""
    return np.array([[number.value for number in row] for row in table.values()])


def distance(numbers: Floats, printed: Floats = PRINTED) -> float:
    """Root mean square of ``numbers / printed - 1``, both [4, 2]."""
    return float(np.sqrt(np.square(numbers / printed - 1.0).mean()))


def reproduce_gaps(settings: ReproductionSettings) -> Made:
    """Table of the quantities that the paper leaves open, and table of the random test with every alternative value."""
    episodes = min(REGISTER_WORLDS, settings.episodes)
    cases = [(DEFAULTS, STATED), *((gap, reading) for gap in (*GAPS, COMBINED) for reading in gap.alternatives)]
    rows = []
    for number, (gap, reading) in enumerate(cases):
        settings.tell(Progress("open quantities", number, len(cases)))
        table = table_of(reading, episodes)
        rates, harms = zip(*table.values(), strict=True)
        rows.append((gap.name, reading.name, distance(rates_and_harms(table)), *harms, *(rate.value for rate in rates)))
    register = [
        (gap.name, gap.paper, gap.ours, "; ".join(reading.name for reading in gap.alternatives) or gap.otherwise)
        for gap in GAPS
    ]
    collisions = [replace(PERCENT, heading=f"Collisions, {row}") for row in PAPER_ROWS]
    note = (
        f"{episodes:,} worlds. Distance: root mean square of ours / printed - 1 over the eight numbers. Then mean harm"
        f" (m²/s²) with its 95 % interval, and the collision rate. {DRIVERS} They are not trained anew for"
        " an alternative."
    )
    far = replace(PERCENT, heading="Distance")
    columns: list[Column | str] = ["Quantity", "Value", far, *map(Column, PAPER_ROWS), *collisions]
    sheets = [
        Sheet(
            "Register of what the paper leaves open",
            ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured"),
            register,
            "Labels are those of the paper's source.",
        ),
        Sheet("The random test with other values", columns, rows, note),
    ]
    return Made(sheets=sheets)
