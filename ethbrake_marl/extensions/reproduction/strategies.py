"""Collisions and harm of each strategy in a reading of the paper (``readings``).

H* is the harm of E-V2X-BM. The paper's *hybrid* follows a policy in the worlds in which the policy's harm is at most
H*, and E-V2X-BM in all others.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cache, lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.reproduction.counting import play_and_count
from ethbrake_marl.extensions.reproduction.readings import OURS, R1, R2, READINGS, Reading
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.scenario import Scenario

VEHICLE_2 = 2  # body
NON_E, E_V2X_BM, COUPLED = "Non-E", "E-V2X-BM", "E-V2X-BM (coupled)"
SHIPPED_SPECS: Mapping[str, str] = MappingProxyType({"PPO": "ppo", "SAC": "sac"})  # specs of the policies
HARMS = {"first": "harm", "total": "total harm"}  # keys of an outcome
PREDICTED = "predicted"  # key of an outcome: harm predicted at the alert, [n] m2/s2
ROUNDING = 1e-9  # larger differences of harm (m2/s2) or deceleration (m/s2) are no rounding errors

Outcome = Mapping[str, NDArray[Any]]  # collided [n]; harm by count (``first`` is ours), [n] m2/s2
Outcomes = Mapping[str, Outcome]  # strategy -> outcome


@lru_cache(16)
def open_reading(reading: Reading, episodes: int) -> tuple[Scenario, Game, State]:
    scenario, game = open_game(reading.scenario(), reward="first-impact-harm")
    return scenario, game, scenario.sample(episodes, SEED)


@cache
def drive(reading: Reading, spec: str, episodes: int) -> Outcome:
    """``spec``: name of an agent, which minimises first-impact harm if it chooses. Exact impacts have all counts."""
    scenario, game, alert = open_reading(reading, episodes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Unfamiliar)
        team = teams_of({spec: spec}, scenario, harm_count="first")[spec]
        if reading.step_s is None:
            last, line_first, pairs_alone = play_and_count(game, alert, team)
            counts = {R1: line_first, R2: pairs_alone}
        else:
            last, counts = play_to_end(game, alert, team), {}
    return {"collided": last.collided, "first": last.harm("first"), "total": last.harm("total"), **counts}


def in_count(outcome: Outcome, count: str) -> Outcome:
    """Harm is ``first``, whatever the count; only ours has ``total``."""
    if count == OURS:
        return {key: outcome[key] for key in ("collided", "first", "total")}
    return {"collided": outcome["collided"], "first": outcome[count]}


def strategies(reading: Reading, episodes: int, policies: Mapping[str, str]) -> dict[str, dict[str, Outcome]]:
    """Count of harm -> name -> outcome. ``policies``: name -> agent name. In the paper's map the only count is ours.

    Every policy also has its hybrid. E-V2X-BM (coupled), which foresees what follows an impact, is included in ours if
    impacts are exact. Outcomes of E-V2X-BM and of hybrids also have the predicted harm (``PREDICTED``).
    """
    bound = pairwise(open_reading(reading._replace(step_s=None), episodes)[2], VEHICLE_2).harm
    specs = {NON_E: "full_brake", E_V2X_BM: "e_v2x_bm:pairwise", **policies}
    driven = {name: drive(reading, spec, episodes) for name, spec in specs.items()}
    exact, of_counts = reading.step_s is None, {}
    for count in READINGS if exact else (OURS,):
        outcomes = {name: in_count(outcome, count) for name, outcome in driven.items()}
        outcomes[E_V2X_BM] = {**outcomes[E_V2X_BM], PREDICTED: bound}
        if exact and count == OURS:
            outcomes[COUPLED] = in_count(drive(reading, "e_v2x_bm", episodes), OURS)
        for name in policies:
            hybrid = algorithm_1(outcomes[name], outcomes[E_V2X_BM], bound)
            outcomes[f"Hybrid {name}"] = {**hybrid, PREDICTED: np.minimum(outcomes[name]["first"], bound)}
        of_counts[count] = outcomes
    return of_counts


def algorithm_1(policy: Outcome, baseline: Outcome, bound: Floats) -> Outcome:
    """The hybrid follows the policy where the policy's harm is at most ``bound``, the harm predicted for E-V2X-BM ([n]
    m2/s2). ``policy``, ``baseline``: outcomes of the policy and of E-V2X-BM.
    """
    follows = policy["first"] <= bound
    return {key: np.where(follows, policy[key], baseline[key]) for key in policy}


def contact_unavoidable(reading: Reading, episodes: int) -> Bools:
    """Whether every strategy has contact, perhaps without an impact: proven in closed form, [n]."""
    return ~avoidability(open_reading(reading, episodes)[2], VEHICLE_2).avoidable


def impact_unavoidable(reading: Reading, episodes: int) -> Bools:
    """Whether it is proven that every strategy has an impact, which is a collision, for exact impacts, [n]."""
    return proven_least_harm(reading, episodes) > 0.0


@cache
def proven_least_harm(reading: Reading, episodes: int) -> Floats:
    """Proven lower bound on the harm of every strategy if impacts are exact and each pair counts, [n] m2/s2."""
    scenario, _, alert = open_reading(reading, episodes)
    return lower_bound(alert, harm_count="first", horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s).harm


def times_above(harm: Floats, bound: Floats) -> int:
    return int(np.count_nonzero(harm > bound + ROUNDING))


def avoided_text(policy: Bools, baseline: Bools) -> str:
    return f"avoids {(baseline & ~policy).sum():,}, adds {(policy & ~baseline).sum():,} of {len(policy):,}"
