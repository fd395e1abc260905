"""The paper's random test (``Table:Random``): collision rate and mean harm of its four strategies.

A *reading* is one interpretation of the paper's text: a value for each quantity that the text leaves open
(``readings``). H* is the harm of E-V2X-BM. The paper's *hybrid* follows a policy in the worlds in which the policy's
harm is at most H*, and E-V2X-BM in all others.
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
from ethbrake_marl.agents.pairwise import (
    CLOSED_FORM_CANDIDATES,
    RELATIVE_TIE,
    ConstantDeceleration,
    find_candidates,
    harm_of_deceleration,
    pairwise,
)
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import ENDED, State
from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.extensions.reproduction.readings import Reading
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.layout import BRAKING, HIT, LATENCY, Bools, Floats
from ethbrake_marl.worlds.scenario import Scenario

VEHICLE_2 = 2  # body
NON_E, E_V2X_BM, HYBRID_SAC, HYBRID_PPO = PAPER_ROWS = "Non-E", "E-V2X-BM", "Hybrid SAC", "Hybrid PPO"  # of the paper
SHIPPED_SPECS: Mapping[str, str] = MappingProxyType({"PPO": "ppo", "SAC": "sac"})  # specs of the policies

WORLD_FIELDS = (
    "base",
    "acts_s",
    "rear_s",
    "step_s",
    "restitution",
    "others",
    "seed",
)  # fields that change worlds, physics
PLANS = ("base", "acts_s", "rear_s", "others", "seed", "plans_as_stated", "star")  # that change what E-V2X-BM plans

ROUNDING = 1e-9  # larger differences of harm (m2/s2) or deceleration (m/s2) are no rounding errors
SHORT_STEP_S = 0.02  # between decisions, where what follows an impact begins at the next decision

RandomTable = Mapping[str, tuple[Estimate, Estimate]]  # row -> collision rate, and mean harm (m2/s2)


RandomOutcome = Mapping[str, NDArray[Any]]  # collided [n]; first, total: harm [n] m2/s2


def outcome_of(last: State) -> RandomOutcome:
    return {"collided": last.collided, "first": last.harm("first"), "total": last.harm("total")}


def avoided_text(policy: Bools, baseline: Bools) -> str:
    return f"avoids {(baseline & ~policy).sum():,}, adds {(policy & ~baseline).sum():,} of {len(policy):,}"


def table_of(reading: Reading, episodes: int) -> RandomTable:
    """Raises ``InvalidInput`` if the reading needs E-V2X-BM (coupled), which needs exact impacts, in the paper's
    fixed-step map.
    """
    specs = "", "", SHIPPED_SPECS["SAC"], SHIPPED_SPECS["PPO"]
    outcomes = {row: report_outcome(row, reading, episodes, spec) for row, spec in zip(PAPER_ROWS, specs, strict=True)}
    return {row: (rate(collided), mean(harm)) for row, (collided, harm) in outcomes.items()}


def report_outcome(row: str, reading: Reading, episodes: int, spec: str = "") -> tuple[Bools, Floats]:
    """Collisions and harm (m2/s2), [n] each. ``spec``: name of the agent that is the policy of a hybrid."""
    worlds, counted = reading.only(*WORLD_FIELDS), reading.counted
    if row == NON_E:
        braking = brake(worlds, None, reading.after_impact, episodes)
        return braking["collided"], braking[counted]
    plans = reading.only(*PLANS)
    baseline, bound = brake(worlds, plans, "brakes on", episodes), plan(plans, episodes).harm
    if row == E_V2X_BM:
        return reported_values(reading.baseline, baseline["collided"], baseline[counted], bound)
    policy = drive_all(worlds, spec, "first", episodes)
    if reading.hybrid == "policy alone":
        return policy["collided"], policy[counted]
    if reading.hybrid == "realised, by the coupled H*":
        baseline = drive_all(worlds, "e_v2x_bm", counted, episodes)
        bound = baseline[counted]
    hybrid = algorithm_1(policy, baseline, bound, counted)
    return reported_values(reading.hybrid, hybrid["collided"], hybrid[counted], np.minimum(policy[counted], bound))


def algorithm_1(policy: RandomOutcome, baseline: RandomOutcome, bound: Floats, counted: str = "first") -> RandomOutcome:
    """The hybrid follows the policy where the policy's harm is at most ``bound``. ``policy``, ``baseline``: outcomes of
    the policy and of E-V2X-BM. ``bound``: harm of E-V2X-BM, predicted or simulated, [n] m2/s2. ``counted``: the harm to
    compare, ``first`` or ``total``.
    """
    follows = policy[counted] <= bound
    return {key: np.where(follows, policy[key], baseline[key]) for key in policy}


def reported_values(numbers: str, collided: Bools, harm: Floats, predicted: Floats) -> tuple[Bools, Floats]:
    """Collisions and harm (m2/s2), [n] each. ``numbers``: ``realised`` (simulated), ``predicted``, or ``predicted harm,
    realised collisions``. ``predicted``: predicted harm.
    """
    if numbers == "predicted":
        return predicted > 0.0, predicted
    return collided, predicted if numbers == "predicted harm, realised collisions" else harm


@lru_cache(16)  # a table needs the worlds of one reading, and those for which E-V2X-BM plans
def open_reading(worlds: Reading, episodes: int) -> tuple[Scenario, Game, State]:
    scenario, game = open_game(worlds.scenario(worlds.base), reward="harm")
    return scenario, game, scenario.sample(episodes, worlds.seed)


@cache
def brake(worlds: Reading, plans: Reading | None, after_impact: str, episodes: int) -> RandomOutcome:
    """``worlds``, ``plans``: readings (interpretations of the paper's text) that define the simulated worlds, and the
    worlds for which E-V2X-BM plans. ``after_impact``: the vehicles of an impact brake on (``brakes on``) or coast from
    the next decision on (``coasts``), or the episode ends (``ends``).
    """
    if after_impact != "brakes on" and worlds.step_s is None:
        worlds = worlds._replace(others=(*worlds.others, ("time_step_s", SHORT_STEP_S)))
    _, game, alert = open_reading(worlds, episodes)
    car = alert.car.copy()
    if plans is not None:
        car[:, BRAKING, VEHICLE_2] = plan(plans, episodes).deceleration_mps2
    state, fully = game.reset(alert._replace(car=car)), np.full((episodes, 1), -1.0)
    while not state.ended.all():
        state, _ = game.step(state, fully)
        if after_impact == "coasts":
            hit = np.maximum(state.line[:, HIT, :-1], state.line[:, HIT, 1:]) == 1.0  # [n, N], in front or behind
            for commands in (state.car[:, BRAKING, 1:], state.wanted[:, 1:]):
                commands[hit] = 0.0
        if after_impact == "ends":
            state.clock[:, ENDED] = np.maximum(state.clock[:, ENDED], state.collided)
    return outcome_of(state)


@cache
def plan(plans: Reading, episodes: int) -> ConstantDeceleration:
    """Deceleration of Vehicle 2 that E-V2X-BM chooses ([n] m/s2), and the harm that it predicts ([n] m2/s2).

    Both follow from the paper's closed form, without restitution and time steps. If several decelerations have the
    least harm, ``plans.star`` selects the smallest, the middle or the largest.
    """
    latencies = () if plans.plans_as_stated else ("acts_s", "rear_s")
    _, _, alert = open_reading(plans.only("base", "others", "seed", *latencies), episodes)
    chosen = pairwise(alert, VEHICLE_2)
    if plans.star == "middle":
        return chosen
    at, ends = np.empty(CLOSED_FORM_CANDIDATES), np.empty((episodes, 2))
    for k, (line, car) in enumerate(zip(alert.line, alert.car.copy(), strict=True)):
        world = line, car[BRAKING], car[LATENCY], VEHICLE_2
        find_candidates(*world, at)  # type: ignore[no-untyped-call]
        possible = at[(at >= 0.0) & (at <= car[BRAKING, VEHICLE_2])]
        harm = np.array([harm_of_deceleration(*world, a) for a in possible])  # type: ignore[no-untyped-call]
        tied = possible[harm <= harm.min() + RELATIVE_TIE * (1.0 + harm.min())]
        ends[k] = tied.min(), tied.max()
    return chosen._replace(deceleration_mps2=ends[:, ("low end", "high end").index(plans.star)])


@cache
def drive_all(worlds: Reading, spec: str, counted: str, episodes: int) -> RandomOutcome:
    """``counted``: harm that the agent minimises, ``first`` or ``total``."""
    scenario, game, alert = open_reading(worlds, episodes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Unfamiliar)
        return outcome_of(play_to_end(game, alert, teams_of({spec: spec}, scenario, harm_count=counted)[spec]))
