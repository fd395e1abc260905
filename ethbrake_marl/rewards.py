"""Reward: a weighted sum of named terms, all computed from the ledger and the state that are also reported.

Terms, for vehicle i and one step (the paper's section on the reward, with its printed defects repaired):

=========  =======================================================================================================
harm       minus the harm of the whole line in this step, each impact once (``harm_count``: first | total); or by how
           much the step raised what the vehicle's ``objective`` makes of the harm so far (``objectives``)
collision  the paper's r_collision: minus ``sum_p k_energy w_p^2`` over every impact of the step
risk       the paper's r_risk over the vehicle's own pairs: ``-sigma(-TTC / tau) - sigma(k_d (d_target - d))``; an
           opening pair has TTC = infinity (first part 0) and ``d - d_safe`` is not negative
jerk       the paper's r_jerk: minus the squared rate of change of the own command
terminal   the paper's r_terminal: 1 when an episode ends without any collision
shaping    for learners: ``discount Phi(after) - Phi(before)``, Phi = minus the least harm ahead (``potential``); such a
           difference of potentials leaves the optimal policy as it is (Ng, Harada and Russell 1999) if
           ``shaping_discount`` is the learner's own discount
=========  =======================================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from scipy.special import expit

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.objectives import Declared, Objective, check_declared, objectives_of
from ethbrake_marl.physics import Bools, Floats, Worlds, forecast

NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Value = TypeVar("Value", float, Floats)
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class RewardParams(BaseModel):
    """Weights of the terms and their constants; a weight of 0 switches a term off.

    Args:
        harm, collision, risk, jerk, terminal, shaping: weights, at least 0, of the terms that this file's head lists.
        harm_count: impacts that count, ``first`` of each pair or ``total``.
        objective: whose harm counts, one name or one for each vehicle; None: the scenario's.
        shaping_discount: the learner's own discount, in (0, 1].
        k_energy: weight of an impact's squared closing speed in the collision term.
        ttc_scale_s: time to collision at which the risk term falls, s.
        safety_buffer_m: distance kept free in the risk term, m.
        target_gap_m: gap below which the risk term rises, m.
        distance_slope_per_m: how steeply it does, 1/m.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random", reward=eb.RewardParams(harm=0.05, terminal=1.0))

    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    harm: NonNegative = 1.0
    harm_count: HarmCount = "first"
    objective: str | Annotated[tuple[str, ...], Field(strict=False)] | None = None  # None: the scenario's
    collision: NonNegative = 0.0
    risk: NonNegative = 0.0
    jerk: NonNegative = 0.0
    terminal: NonNegative = 0.0
    shaping: NonNegative = 0.0
    shaping_discount: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    k_energy: NonNegative = 1.0
    ttc_scale_s: Positive = 1.0
    safety_buffer_m: NonNegative = 1.0
    target_gap_m: NonNegative = 3.0
    distance_slope_per_m: Positive = 1.0

    @field_validator("objective", mode="before")
    @classmethod
    def _objective(cls, value: Any) -> Any:
        if value is not None:
            try:
                check_declared(value)
            except InvalidInput as error:
                raise ValueError(str(error).removeprefix("objective: ")) from None
        return value


REWARDS = {
    "harm": RewardParams(),
    "total-harm": RewardParams(harm_count="total"),
    "paper": RewardParams(harm=0.0, collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0),
}

_BRAKING_SHARES = np.linspace(0.0, 1.0, 9)
_ROUNDS = 2  # of several learners


Reward = str | RewardParams | Mapping[str, Any]  # a name, or settings


def reward_params(reward: Reward) -> RewardParams:
    """Look up a named reward, build one from a mapping of settings, or pass one through.

    Raises ``UnknownName`` for an unknown name or setting and ``InvalidInput`` for a value out of its range.
    """
    if isinstance(reward, RewardParams):
        return reward
    if isinstance(reward, Mapping):
        return _from_settings(reward)
    if not isinstance(reward, str):
        raise InvalidInput(
            f"reward = {reward!r}: must be a name ({', '.join(REWARDS)}), a mapping such as {{'harm': 1.0}}, or"
            " RewardParams"
        )
    if reward not in REWARDS:
        raise unknown_name("reward", reward, REWARDS)
    return REWARDS[reward]


def resolved_objective(
    params: RewardParams, of_scenario: Declared, vehicles: int
) -> tuple[RewardParams, tuple[Objective, ...]]:
    """The reward with its objective settled (the scenario's where it has none), and that of each vehicle.

    Everybody's harm alike, the usual one, is ``None`` and no objectives: it needs no telling apart.
    Raises ``InvalidInput`` for an objective that does not fit the number of vehicles.
    """
    declared = of_scenario if params.objective is None else params.objective
    try:
        objectives = objectives_of(declared, vehicles)
    except InvalidInput as error:  # the scenario's was found to fit when it was made
        raise InvalidInput(f"reward: {error}") from None
    if all(objective.kind == "total" for objective in objectives):
        return params.model_copy(update={"objective": None}), ()
    return params.model_copy(update={"objective": declared}), objectives


def _from_settings(settings: Mapping[str, Any]) -> RewardParams:
    for name in settings:
        if name not in RewardParams.model_fields:
            raise unknown_name("setting of a reward", name, RewardParams.model_fields)
    try:
        return RewardParams(**settings)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        right = first["msg"].replace("Input should be", "must be").replace("a valid number", "a number")
        right = right.removeprefix("Value error, ")
        raise InvalidInput(f"reward: {first['loc'][0]} = {first['input']!r}: {right}") from None


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """What the terms of one step are computed from."""

    first_impact_harm: Floats  # [n] of the whole line in this step
    total_harm: Floats  # [n] likewise
    safe_end: Bools  # [n] the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] after the step
    speeds_mps: Floats  # [n, N] after the step
    command_mps2: Floats  # [n, N] in force after the step
    previous_mps2: Floats  # [n, N] in force before it
    time_step_s: float


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


def reward_terms(params: RewardParams, step: StepOutcome) -> dict[str, Floats]:
    """Unweighted terms of one step, each [n, N]; only those with a weight above 0 (all but shaping)."""
    harm = step.first_impact_harm if params.harm_count == "first" else step.total_harm
    shared = shared_terms(params, harm, step.safe_end.astype(np.float64))
    spread = {name: _shared(term, step.speeds_mps.shape) for name, term in shared.items()}
    return spread | further_terms(params, step)


def further_terms(params: RewardParams, step: StepOutcome) -> dict[str, Floats]:
    """The terms that need the motion: collision, risk, jerk."""
    terms: dict[str, Floats] = {}
    if params.collision > 0.0:
        terms["collision"] = _shared(-params.k_energy * step.total_harm, step.speeds_mps.shape)
    if params.risk > 0.0:
        terms["risk"] = _risk(params, step)
    if params.jerk > 0.0:
        rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s
        terms["jerk"] = -rate * rate
    return terms


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
        total += getattr(params, name) * term
    return total


def _shared(world_value: Floats, shape: tuple[int, ...]) -> Floats:
    return world_value.repeat(shape[1]).reshape(shape)


def _risk(params: RewardParams, step: StepOutcome) -> Floats:
    closing = step.speeds_mps[:, 1:] - step.speeds_mps[:, :-1]
    room = np.maximum(step.gaps_m - params.safety_buffer_m, 0.0)
    approaching = closing > 0.0
    time_to_collision = room / np.where(approaching, closing, 1.0)
    urgency = np.where(approaching, expit(-time_to_collision / params.ttc_scale_s), 0.0)
    nearness = expit(params.distance_slope_per_m * (params.target_gap_m - step.gaps_m))
    pair_risk = -(urgency + nearness)
    risk = np.zeros(step.speeds_mps.shape)
    risk[:, :-1] += pair_risk
    risk[:, 1:] += pair_risk
    return risk
