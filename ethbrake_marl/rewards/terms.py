"""The terms of a reward as functions of one step, and the potential of the shaping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, forecast
from ethbrake_marl.physics.elementary import logistic
from ethbrake_marl.rewards.params import RewardParams
from ethbrake_marl.rewards.registry import TERMS, StepOutcome, Term, checked_term

Value = TypeVar("Value", float, Floats)

_BRAKING_SHARES = np.linspace(0.0, 1.0, 9)
_ROUNDS = 2  # of several learners


def shared_terms(params: RewardParams, harm: Value, safe_end: Value) -> dict[str, Value]:
    """The terms that all vehicles share and that need no more than the step's facts, of many worlds [n] or of one.

    ``harm`` as counted; ``safe_end`` is 1 or 0. With an objective other than everybody's harm, harm is not shared.
    """
    terms = {}
    if params.harm > 0.0 and params.objective is None:
        terms["harm"] = -harm
    if params.terminal > 0.0:
        terms["terminal"] = safe_end
    return terms


def counted_terms(params: RewardParams) -> tuple[str, ...]:
    """Names of the terms that this reward counts, in the order of the table."""
    return tuple(name for name in TERMS if params.weight(name) > 0.0)


def reward_terms(params: RewardParams, step: StepOutcome) -> dict[str, Floats]:
    """Unweighted terms of one step, each [n, N]; only those with a weight above 0 (all but shaping)."""
    harm = step.first_impact_harm if params.harm_count == "first" else step.total_harm
    shared = shared_terms(params, harm, step.safe_end.astype(np.float64))
    spread = {name: _shared(term, step.speeds_mps.shape) for name, term in shared.items()}
    return spread | further_terms(moving_terms_of(params), params, step)


def moving_terms_of(params: RewardParams) -> list[Term]:
    """The built-in terms that need the motion, of those that this reward counts: collision, risk, jerk."""
    return [t for t in TERMS.values() if t.function and not t.registered and params.weight(t.name) > 0.0]


def further_terms(terms: Sequence[Term], params: RewardParams, step: StepOutcome) -> dict[str, Floats]:
    """Built-in terms of one step that need the motion, each [n, N]."""
    return {term.name: term.function(params, step) for term in terms if term.function is not None}


def registered_terms_of(params: RewardParams) -> list[Term]:
    """The registered terms that this reward counts."""
    return [TERMS[name] for name, weight in params.terms.items() if weight > 0.0]


def own_terms(terms: Sequence[Term], step: StepOutcome, counts: Bools, steps: Ints) -> dict[str, Floats]:
    """Registered terms of one step, each [n, N]; see ``checked_term``. They cannot change what they are given."""
    for name in StepOutcome.__slots__:
        if isinstance(given := getattr(step, name), np.ndarray):
            given.flags.writeable = False
    return {term.name: checked_term(term, step, counts, steps) for term in terms}


def potential(params: RewardParams, worlds: Worlds, learners: Sequence[int], horizon_s: float) -> Floats:
    """Minus the least harm ahead, [n], that was found with a constant deceleration of each learner from now on.

    All others brake fully; harm is what ``harm_count`` counts, from now to the horizon, in the engine's own physics.
    One learner takes the best of nine shares of its capacity. Several begin with full braking and choose so one after
    the other, front to rear, twice round, each given what the others have chosen: all have the same potential.
    """
    braking = worlds.vehicles.braking_capacity_mps2
    command, least = -braking, np.zeros(worlds.n)
    for _ in range(1 if len(learners) == 1 else _ROUNDS):
        for vehicle in learners:
            candidates = -braking[:, vehicle, np.newaxis] * _BRAKING_SHARES
            harm = forecast(worlds, command, vehicle, candidates, horizon_s)[0 if params.harm_count == "first" else 1]
            choice = harm.argmin(axis=1)[:, np.newaxis]
            command[:, vehicle] = np.take_along_axis(candidates, choice, axis=1)[:, 0]
            least = np.take_along_axis(harm, choice, axis=1)[:, 0]
    return -least


def weighted_sum(params: RewardParams, terms: Mapping[str, Floats], shape: tuple[int, ...]) -> Floats:
    """Reward of every vehicle, [n, N]."""
    total = np.zeros(shape)
    for name, term in terms.items():
        total += params.weight(name) * term
    return total


def _shared(world_value: Floats, shape: tuple[int, ...]) -> Floats:
    return world_value.repeat(shape[1]).reshape(shape)


def _collision(params: RewardParams, step: StepOutcome) -> Floats:
    return _shared(-params.k_energy * step.total_harm, step.speeds_mps.shape)


def _jerk(params: RewardParams, step: StepOutcome) -> Floats:
    rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s
    return -rate * rate


def _risk(params: RewardParams, step: StepOutcome) -> Floats:
    closing = step.speeds_mps[:, 1:] - step.speeds_mps[:, :-1]
    room = np.maximum(step.gaps_m - params.safety_buffer_m, 0.0)
    approaching = closing > 0.0
    time_to_collision = room / np.where(approaching, closing, 1.0)
    urgency = np.where(approaching, logistic(-time_to_collision / params.ttc_scale_s), 0.0)
    nearness = logistic(params.distance_slope_per_m * (params.target_gap_m - step.gaps_m))
    pair_risk = -(urgency + nearness)
    risk = np.zeros(step.speeds_mps.shape)
    risk[:, :-1] += pair_risk
    risk[:, 1:] += pair_risk
    return risk


TERMS.update(
    (term.name, term)
    for term in (
        Term("harm", "minus the harm of the step, as `harm_count` and `objective` count it", "m2/s2", 1.0, None),
        Term("collision", "minus `k_energy` times the harm of every impact of the step", "m2/s2", 0.0, _collision),
        Term("risk", "minus how near and how soon a collision of each own pair is, 0 to 2 a pair", "1", 0.0, _risk),
        Term("jerk", "minus the squared rate of change of the own command", "m2/s6", 0.0, _jerk),
        Term("terminal", "1 when an episode ends without any collision", "1", 0.0, None),
        Term("shaping", "difference of potentials: minus the least harm ahead, for learners", "m2/s2", 0.0, None),
    )
)
