"""The register of what the paper leaves open: each quantity, what the paper says of it, our default, alternatives.

``gaps`` measures how far the headline moves when a quantity changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Harm = Literal["first", "total", "sampled", "predicted"]


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another reading of a quantity, and how it is put into the random test."""

    value: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # of the scenario
    seed: int | None = None  # of the list
    harm: Harm = "first"  # what is counted
    bound: Literal["coupled", "pairwise"] | None = None  # of the hybrid that drives in the place of PPO


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """A quantity that the paper leaves open, or that can be read in two ways."""

    name: str
    paper: str  # what it says, with the label in its source
    ours: str
    alternatives: tuple[Alternative, ...] = ()
    trained: str = ""  # the trainings of ``--full`` that measure it begin with this name
    unmeasured: str = ""  # why nothing is measured

    @property
    def is_measured(self) -> bool:
        """Whether alternatives are driven here."""
        return bool(self.alternatives)


def _of(key: str, *values: float, unit: str = "") -> tuple[Alternative, ...]:
    return tuple(Alternative(f"{value:g}{unit}", {key: value}) for value in values)


GAPS = (
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        _of("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("time step Δt", "sec:optimization_problem: a sampling period, no number", "0.1 s",
        _of("time_step_s", 0.05, 0.2, unit=" s")),
    Gap("impacts at samples or exact", "dynamics2: at samples", "at their exact time; each impact once",
        (Alternative("the paper's map at 0.1 s, harm at every sample of an overlap (eq:Jharmn)", harm="sampled"),)),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", _of("horizon_s", 5.0, 16.0, unit=" s")),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", _of("speed_limit_mps", 25.0, unit=" m/s")),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s",
        (Alternative("0.2 s", {"latency_s": [0, 0.2, 0.8]}), Alternative("0.3 s", {"latency_s": [0, 0.3, 0.8]}))),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0",
        (Alternative("from τ2 (τ3 = 1.3 s)", {"latency_s": [0, 0.5, 1.3]}),)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", (Alternative("every impact", harm="total"),)),
    Gap("H* of E-V2X-BM, predicted or realised", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        (Alternative("predicted, pair by pair", harm="predicted"),)),
    Gap("H* inside the hybrid", "alg:hybrid: H* of Eq:BaselineHarm", "realised (coupled)",
        (Alternative("hybrid with realised H*", bound="coupled"),
         Alternative("hybrid with predicted H*", bound="pairwise"))),
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
        "brake until they stand", unmeasured="the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", trained="ppo-paper-"),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features", trained="ppo-paper-state"),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        trained="ppo-paper"),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        unmeasured="one training each takes minutes; docs/learning.md compares recipes"),
)  # fmt: skip
