"""Which one change makes a claim of the paper true? Numbers as stated, and after the change."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.extensions.reproduction.curves import DISTANCE, DISTANCE_WORLDS, by_distance, harm_of_strategies
from ethbrake_marl.extensions.reproduction.made import DRIVERS, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.paper_rows import HYBRID_TEST
from ethbrake_marl.extensions.reproduction.random_test import E_V2X_BM, NON_E, ROUNDING, SHIPPED_SPECS, RandomOutcome
from ethbrake_marl.extensions.reproduction.readings import STATED
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    PREDICTED,
    SIMULATED,
    above_bound,
    proven_least_harm,
    strategies,
)
from ethbrake_marl.extensions.reproduction.verdicts import paper_texts
from ethbrake_marl.files.sheet import Sheet

EARLY_S = 0.2  # time at which Vehicle 2 acts, at which the row of Non-E comes out


def reproduce_changes(settings: ReproductionSettings) -> Made:
    """People write claims and changes; numbers are ours."""
    episodes = settings.episodes
    readings = STATED, STATED._replace(acts_s=EARLY_S)
    stated, early = (strategies(reading, episodes, SHIPPED_SPECS) for reading in readings)
    distance, worlds = STATED._replace(base=DISTANCE), min(DISTANCE_WORLDS, episodes)
    (lines, shortest), *_ = by_distance(distance, worlds, harm_of_strategies(distance, worlds, {})).values()
    collisions = [row.episodes - row.collisions for row in HYBRID_TEST]
    bounds = {"": E_V2X_BM, f", {SIMULATED}": COUPLED}  # ending of the hybrid's name -> its E-V2X-BM
    numbers = {
        "reliable": "; ".join(
            f"hybrid with {name} "
            + " -> ".join(f"{stated[f'Hybrid {name}{ending}']['first'].mean():.2f}" for ending in bounds)
            + f", {name} alone {stated[name]['first'].mean():.2f}"
            for name in SHIPPED_SPECS
        ),
        "bound": "; ".join(
            f"hybrid with {name} above it in "
            + " -> ".join(f"{above_bound(stated[f'Hybrid {name}{ending}']):,}" for ending in bounds)
            for name in SHIPPED_SPECS
        ),
        "lower": "; ".join(
            f"hybrid with {name} not the lower in "
            + " -> ".join(f"{not_lower(stated, name, ending, bounds[ending]):,}" for ending in bounds)
            for name in SHIPPED_SPECS
        ),
        "overall": " -> ".join(
            f"{stated[name][PREDICTED].mean():.2f} for {stated[name]['first'].mean():.2f}" for name in bounds.values()
        ),
        "baseline": f"{stated[E_V2X_BM]['first'].mean():.2f} -> {stated[E_V2X_BM][PREDICTED].mean():.2f}",
        "short gaps": f"{NON_E} {lines[NON_E][shortest].mean():.2f}, {E_V2X_BM}"
        f" {lines[E_V2X_BM][shortest].mean():.2f} -> {lines[COUPLED][shortest].mean():.2f}",
        "braking": " -> ".join(
            f"{NON_E} {100.0 * outcomes[NON_E]['collided'].mean():.1f} % and {outcomes[NON_E]['first'].mean():.2f}"
            for outcomes in (stated, early)
        ),
        "least": "least possible "
        + " -> ".join(
            f"{100.0 * (least > 0.0).mean():.1f} % and {least.mean():.2f}"
            for least in (proven_least_harm(reading, episodes) for reading in readings)
        ),
        "avoided": f"{collisions[2]:,} for at most {collisions[0]:,} + {collisions[1]:,}",
    }
    rows = [(row["claim"], row["change"], numbers[row["result"]]) for row in paper_texts()["changes"]]
    note = "As stated -> with the change. Mean harm in m²/s²; shares and counts are of worlds."
    return Made(sheets=[Sheet("Claims and changes", ("Claim", "Change", "Numbers"), rows, note)], notes=[DRIVERS])


def not_lower(outcomes: Mapping[str, RandomOutcome], policy: str, ending: str, baseline: str) -> int:
    """Number of worlds in which the hybrid does more harm than the better of its two strategies."""
    lower = np.minimum(outcomes[policy]["first"], outcomes[baseline]["first"])
    return int(np.count_nonzero(outcomes[f"Hybrid {policy}{ending}"]["first"] > lower + ROUNDING))
