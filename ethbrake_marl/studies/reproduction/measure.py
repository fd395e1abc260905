"""Strategies on the paper's worlds, at the latencies that it states and with Vehicle 2 acting at 0.2 s."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, make_agents
from ethbrake_marl.evaluation.statistics import Estimate, mean, paired_difference, rate
from ethbrake_marl.figures.reproduction import Line
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.studies.reproduction.item import LIST_SEED, Settings
from ethbrake_marl.studies.reproduction.verdicts import Less

FULL_BRAKE, PAIRWISE, COUPLED = "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm"
SAC, PPO, UNIVERSAL = "sac@shipped/sac", "ppo@shipped/ppo", "ppo@shipped/universal-ppo"
PREDICTED, PROVEN = "E-V2X-BM, predicted", "least harm, proven"
NAMES = {  # of the strategies in tables and figures
    FULL_BRAKE: "Non-ethical (full braking)",
    PAIRWISE: "E-V2X-BM, realised",
    COUPLED: "E-V2X-BM, coupled",
    SAC: "SAC",
    PPO: "PPO",
    UNIVERSAL: "universal policy",
}
FOUR = (FULL_BRAKE, PAIRWISE, COUPLED, SAC, PPO)  # the paper's four, E-V2X-BM twice
ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)
ABOUT_POLICIES = "PPO and SAC are the shipped policies, trained on paper-random at 0.5 and 0.8 s"


@dataclass(frozen=True, slots=True)
class Reading:
    """A time from which Vehicle 2 acts."""

    name: str
    acts_s: float | None  # None: the scenario's own

    def of(self, scenario: Scenario) -> Scenario:
        """The scenario so read."""
        if self.acts_s is None:
            return scenario
        first, _, *others = scenario.model_dump()["latency_s"]
        return scenario.replace(latency_s=[first, self.acts_s, *others])


AS_STATED, AT_200_MS = Reading("as stated", None), Reading("Vehicle 2 acts at 0.2 s", 0.2)
READINGS = (AS_STATED, AT_200_MS)


def read_scenario(name: str, reading: Reading) -> Scenario:
    """A shipped scenario in a reading."""
    return reading.of(load_scenario(name))


def lineup(specs: Sequence[str], scenario: Scenario) -> dict[str, Agent]:
    """Agents by their names in ``NAMES``, else by their spec."""
    return {NAMES.get(spec, spec): agent for spec, agent in make_agents(specs, scenario).items()}


def drive_list(scenario: Scenario, agents: Mapping[str, Agent], episodes: int, settings: Settings) -> Evaluation:
    """Let every agent drive the first worlds of the list."""
    return evaluate(
        scenario.sample(episodes, LIST_SEED),
        agents,
        scenario=scenario,
        seed=LIST_SEED,
        chunk=PROGRESS_EVERY,
        aftermath=False,
        on_progress=lambda name, done: settings.say(scenario.name, done, episodes),
    )


def collision_rate(collided: Bools) -> Estimate:
    """Share of worlds with an impact."""
    return rate(int(collided.sum()), len(collided))


def harms(evaluation: Evaluation) -> dict[str, Floats]:
    """First-impact harm of each strategy in each world, what E-V2X-BM predicts, what nobody undercuts, [n] m2/s2."""
    found = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    pairwise = evaluation.outcomes.get(NAMES[PAIRWISE])
    if pairwise is not None and pairwise.predicted_harm is not None:
        found = {**found, PREDICTED: pairwise.predicted_harm}
    proven = proven_harm(evaluation)
    return found if proven is None else {**found, PROVEN: proven}


def proven_harm(evaluation: Evaluation) -> Floats | None:
    """The harm of each world that no command undercuts, [n] m2/s2; None where nothing is proven."""
    limits = evaluation.limits
    return None if isinstance(limits, Unproven) else limits.proof.harm


def less_in(where: str, harm: Mapping[str, Floats], smaller: str, larger: str) -> Less:
    """That one strategy harms less than another in the same worlds, and whether anybody could."""
    low, high = harm[smaller], harm[larger]
    least = paired_difference(harm[PROVEN], high) if PROVEN in harm else None
    return Less(where, paired_difference(low, high), not low.any() and not high.any(), least)


DISTANCES_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # ends of the groups of d_1 + d_2


@dataclass(frozen=True, slots=True)
class Grouped:
    """Harm of each strategy over groups of the total distance."""

    groups: tuple[str, ...]
    at_m: tuple[float, ...]  # mean distance of each group
    rows: tuple[Bools, ...]  # of each group, which worlds
    harm: Mapping[str, Floats]

    def estimate(self, strategy: str, group: int) -> Estimate:
        """Mean harm of a strategy in a group."""
        return mean(self.harm[strategy][self.rows[group]])

    def line(self, strategy: str) -> Line:
        """Of one strategy, for a figure."""
        return Line.of(self.at_m, [self.estimate(strategy, k) for k in range(len(self.groups))])

    def less(self, smaller: str, larger: str) -> list[Less]:
        """The comparison of two strategies in every group, paired by world."""
        return [
            less_in(group, {name: harm[rows] for name, harm in self.harm.items()}, smaller, larger)
            for group, rows in zip(self.groups, self.rows, strict=True)
        ]


def group_by_distance(evaluation: Evaluation) -> Grouped:
    """Group the worlds by the sum of their gaps; groups without a world are left out."""
    total = evaluation.worlds.gaps_m.sum(axis=1)
    inner = np.digitize(total, DISTANCES_M[1:-1])
    kept = [k for k in range(len(DISTANCES_M) - 1) if (inner == k).any()]
    rows = tuple(inner == k for k in kept)
    names = tuple(f"{DISTANCES_M[k]:g}-{DISTANCES_M[k + 1]:g} m" for k in kept)
    return Grouped(names, tuple(float(total[each].mean()) for each in rows), rows, harms(evaluation))
