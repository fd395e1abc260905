"""Collisions and harm of each strategy: the paper's four, ours for comparison, and policies trained as in the paper.

A *reading* is one interpretation of the paper's text (``readings``).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.reproduction.learning import process
from ethbrake_marl.extensions.reproduction.made import ReproductionSettings
from ethbrake_marl.extensions.reproduction.random_test import (
    E_V2X_BM,
    NON_E,
    PLANS,
    ROUNDING,
    WORLD_FIELDS,
    RandomOutcome,
    algorithm_1,
    brake,
    drive_all,
    open_reading,
    plan,
)
from ethbrake_marl.extensions.reproduction.readings import Reading
from ethbrake_marl.motion.layout import Floats

COUPLED, SIMULATED = "E-V2X-BM (coupled)", "simulated H*"
PAPERS = "paper's process"
PREDICTED = "predicted"  # key of an outcome: harm predicted at the alert, [n] m2/s2
MAP_STEP_S = 0.1


def strategies(reading: Reading, episodes: int, policies: Mapping[str, str]) -> dict[str, RandomOutcome]:
    """Outcome by name.

    Every policy also has a hybrid (``algorithm_1``), which compares first-impact harm. If impacts are exact, E-V2X-BM
    (coupled) and its hybrids are included. Outcomes of E-V2X-BM and of hybrids also have the predicted harm
    (``PREDICTED``).
    """
    worlds, plans = reading.only(*WORLD_FIELDS), reading.only(*PLANS)
    baseline = {**brake(worlds, plans, "brakes on", episodes), PREDICTED: plan(plans, episodes).harm}
    outcomes: dict[str, RandomOutcome] = {NON_E: brake(worlds, None, "brakes on", episodes), E_V2X_BM: baseline}
    hybrids: dict[str, RandomOutcome] = {"": baseline}  # ending of the hybrid's name -> outcome of its E-V2X-BM
    if reading.step_s is None:  # exact impacts
        coupled = drive_all(worlds, "e_v2x_bm", "first", episodes)
        outcomes[COUPLED] = {**coupled, PREDICTED: coupled["first"]}
        hybrids[f", {SIMULATED}"] = outcomes[COUPLED]
    outcomes |= {name: drive_all(worlds, spec, "first", episodes) for name, spec in policies.items()}
    for name in policies:
        for ending, bound in hybrids.items():
            least = {PREDICTED: np.minimum(outcomes[name]["first"], bound[PREDICTED])}
            outcomes[f"Hybrid {name}{ending}"] = {**algorithm_1(outcomes[name], bound, bound[PREDICTED]), **least}
    return outcomes


def above_bound(hybrid: RandomOutcome) -> int:
    return int(np.count_nonzero(hybrid["first"] > hybrid[PREDICTED] + ROUNDING))


def process_outcomes(
    reading: Reading, episodes: int, settings: ReproductionSettings
) -> dict[str, list[dict[str, RandomOutcome]]]:
    """Policy -> for each seed, strategy -> outcome. The strategies are those of ``strategies`` with this one policy.
    Empty if there are no such trainings.
    """
    mapped = reading._replace(step_s=MAP_STEP_S)
    return {
        name: [strategies(mapped, episodes, {name: spec}) for spec in specs]
        for name, specs in process(settings).items()
    }


def proven_least_harm(reading: Reading, episodes: int) -> Floats:
    """Proven lower bound on the harm of every strategy in the worlds of ``reading``, for exact impacts, [n] m2/s2."""
    scenario, _, alert = open_reading(reading.only(*WORLD_FIELDS), episodes)
    return lower_bound(alert, harm_count="first", horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s).harm
