"""Rewards: a reward is a weighted sum of terms, each of which is a measure (``game.measures``).

The table shows the value of each built-in term for a vehicle in one step. The terms ``collision``, ``risk``, ``jerk``
and ``terminal`` come from the paper, with misprints corrected:

=========  =======================================================================================================
term       value
=========  =======================================================================================================
harm       minus the harm of the whole line in this step (``harm_count``: first-impact or total harm); with an
           ``objective``, minus the change in this step of the amount that the vehicle should minimise
collision  minus ``sum k_energy w^2`` over every impact of the step, where w is the closing speed
risk       sum of ``-sigma(-TTC / tau) - sigma(k_d (d_target - d))`` over the vehicle's pairs, with logistic function
           sigma, gap d and time to collision ``TTC = max(d - d_safe, 0) / closing speed``; the first part is 0 if the
           vehicles of a pair do not approach each other
jerk       minus the squared rate of change of the vehicle's acceleration
terminal   1 in the last step of an episode without any collision, otherwise 0
shaping    for learners: ``discount Phi(after) - Phi(before)``, where Phi is minus the least harm that the learners can
           reach by constant braking (``potential``). The term does not change the optimal policy if
           ``shaping_discount`` equals the learner's own discount (Ng, Harada and Russell 1999)
=========  =======================================================================================================
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from operator import not_
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.model import UNSHOWN, FileModel, first_mistake, require
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.measures import BUILT_IN, MEASURES
from ethbrake_marl.first_edition.game.objectives import Declared, Objective, check_declared, objectives_of
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.state import Floats, Worlds


class WithoutEffect(UserWarning):
    """Warning that a setting has no effect, for example an objective in a reward that gives harm the weight 0."""


def own_terms() -> list[str]:
    """Return the names of the registered measures, without the built-in measures and without loading any package."""
    return [name for name in MEASURES if name not in RewardParams.model_fields]


NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Finite = Annotated[float, Field(allow_inf_nan=False)]

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

Value = TypeVar("Value", float, Floats)

_BRAKING_SHARES = np.linspace(0.0, 1.0, 9)

_ROUNDS = 2  # how often each of several learners chooses its deceleration in ``potential``


class RewardParams(FileModel):
    """Weights and constants of the terms of a reward. A term with weight 0 is not computed.

    Args:
        harm, collision, risk, jerk, terminal, shaping: weights of the built-in terms, at least 0; the module
            ``game.rewards`` has the formulas. If you give a weight for any term other than harm, you must also give the
            weight of harm.
        harm_count: ``first``: the term harm uses first-impact harm; ``total``: total harm.
        objective: objective of all vehicles, or a list with one objective per vehicle; None: the objective of the
            scenario.
        shaping_discount: discount in the shaping term, in (0, 1]; it should equal the learner's own discount.
        k_energy: factor of the squared closing speed in the collision term.
        ttc_scale_s: time tau by which the risk term divides the time to collision, s.
        safety_buffer_m: distance d_safe that is subtracted from the gap in the risk term, m.
        target_gap_m: gap d_target below which the second part of the risk term exceeds 1/2, m.
        distance_slope_per_m: steepness k_d of the second part of the risk term, 1/m.
        terms: name of a registered measure -> weight; use a negative weight for a measure that should become small.

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.EthBrakeEnv("paper-random", reward=eb.RewardParams(harm=0.05, terminal=1.0))

    """

    harm: NonNegative = 1.0
    harm_count: HarmCount = "first"
    objective: str | Annotated[tuple[str, ...], Field(strict=False)] | None = None
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
    # weights of registered measures; a file or mapping may also write them next to the other settings
    terms: dict[str, Finite] = Field(default_factory=dict, validate_default=True, exclude_if=not_)

    @model_validator(mode="before")
    @classmethod
    def _own_terms(cls, value: Any) -> Any:
        """Move into ``terms`` the weights of registered measures that are written next to the other settings."""
        if not isinstance(value, dict):
            return value
        beside = {name: weight for name, weight in value.items() if name in own_terms()}
        if not beside:
            return value
        inside = value.get("terms", {})
        if not isinstance(inside, dict) or beside.keys() & inside.keys():
            raise ValueError(
                "write the weight of a registered measure either in the mapping terms or next to the other settings,"
                " not in both places"
            )
        return {**{name: each for name, each in value.items() if name not in beside}, "terms": {**inside, **beside}}

    @field_validator("terms")
    @classmethod
    def _settled(cls, value: dict[str, float]) -> dict[str, float]:
        """Load the registered measures in ``terms``; return ``terms`` without the measures of weight 0."""
        for name in value:
            if name not in own_terms():
                raise unknown_name("measure", name, own_terms(), may_be_own=True)
        return {name: value[name] for name in sorted(value) if value[name] != 0.0 and MEASURES[name]}

    @field_validator("objective", mode="before")
    @classmethod
    def _objective(cls, value: Any) -> Any:
        if value is not None:
            try:
                check_declared(value)
            except InvalidInput as error:
                raise ValueError(str(error).removeprefix("objective: ")) from None
        return value

    @model_validator(mode="after")
    def _harm_is_meant(self) -> Self:
        """Raise an error if weights are given without the weight of harm, or if an objective is given although harm has
        weight 0.

        The weight of harm is 1 by default, so a user who gives only the weights of other terms would unknowingly get a
        reward that also includes harm.
        """
        names = {*self.model_fields_set, *(self.terms if "terms" in self.model_fields_set else ())}
        beside = [name for name, weight in self.weights.items() if weight != 0.0 and name in names]
        right = (
            f"must be given together with {''.join(beside[:1])}, because its default weight is 1; write harm: 1, or"
            " harm: 0 for a reward without harm"
        )
        require(not beside or "harm" in names, ("harm",), UNSHOWN, right)
        right = "has no effect, because it changes only the term harm, whose weight is 0; leave it out or give a weight"
        require(self.objective is None or self.harm > 0.0, ("objective",), UNSHOWN, right)
        return self

    def weight(self, term: str) -> float:
        """Return the weight of the built-in term or registered measure ``term``; 0 if the reward has no such term."""
        weight: float = self.terms[term] if term in self.terms else self.__dict__.get(term, 0.0)
        return weight

    @property
    def weights(self) -> dict[str, float]:
        """Dictionary from name to weight, for every built-in term and every registered measure in ``terms``."""
        return {name: self.weight(name) for name in (*BUILT_IN, *self.terms)}

    @property
    def counted(self) -> tuple[str, ...]:
        """Names of the terms whose weight is not 0: first the built-in terms, then the registered measures."""
        return tuple(name for name, weight in self.weights.items() if weight != 0.0)

    def shared(self, harm: Value, safe_end: Value) -> dict[str, Value]:
        """Return the terms whose values all vehicles of a world share, by name: ``harm`` and ``terminal``.

        A term with weight 0 is left out. If there is an objective, the term harm is also left out, because each vehicle
        has its own value of this term.

        ``harm`` is the harm of the step in m2/s2, for n worlds [n] or as one number for a single world. ``safe_end``
        has the same shape, and is 1 if the episode ended in this step without any collision, else 0.
        """
        terms = {}
        if self.harm > 0.0 and self.objective is None:
            terms["harm"] = -harm
        if self.terminal > 0.0:
            terms["terminal"] = safe_end
        return terms

    def weighted_sum(self, terms: Mapping[str, Floats], shape: tuple[int, ...]) -> Floats:
        """Return the reward of every vehicle, [n, N]: the sum of weight times value over all ``terms``.

        ``terms`` maps names to values, [n] or [n, N]. ``shape`` is the shape (n, N) of the result.
        """
        total = np.zeros(shape)
        for name, term in terms.items():
            total += self.weight(name) * (term if term.ndim == 2 else term[:, np.newaxis])
        return total

    def settled(self, of_scenario: Declared, vehicles: int) -> tuple[RewardParams, tuple[Objective, ...]]:
        """Return a copy of this reward whose ``objective`` is the one in use, and the parsed objective of each vehicle.

        The objective comes from the reward or, if the reward has none, from the scenario (``of_scenario``). If all
        vehicles have the objective ``total``, or if harm has weight 0, ``objective`` becomes None and the tuple of
        parsed objectives is empty. If harm has weight 0 and the scenario has another objective than ``total``, a
        warning (``WithoutEffect``) says that this objective has no effect. Raises ``InvalidInput`` if the objective of
        the reward contains texts or weights for another number of vehicles.
        """
        declared = of_scenario if self.objective is None else self.objective
        try:
            objectives = objectives_of(declared, vehicles)
        except InvalidInput as error:  # only the reward's objective can be invalid; the scenario's was checked before
            raise InvalidInput(f"reward: {error}") from None
        usual = all(objective.kind == "total" for objective in objectives)
        if not usual and self.harm == 0.0:
            what = f"the scenario's objective, {declared if isinstance(declared, str) else ', '.join(declared)},"
            warnings.warn(
                WithoutEffect(f"{what} has no effect, because the weight of harm in this reward is 0"), stacklevel=2
            )
        if usual or self.harm == 0.0:
            return self.model_copy(update={"objective": None}), ()
        return self.model_copy(update={"objective": declared}), objectives

    def potential(self, worlds: Worlds, learners: Sequence[int], horizon_s: float) -> Floats:
        """Return the potential of the shaping term, [n] m2/s2: minus the least harm with constant braking from now on.

        Each learner is assumed to brake with a constant deceleration, and all other vehicles fully. For each learner
        nine decelerations are tried, from 0 to the learner's braking capacity in equal steps. A single learner takes
        the deceleration with the least harm. Several learners begin with full braking and choose their decelerations
        one after the other, front to rear, in two rounds; all learners get the same potential.

        ``learners`` are indices (0 = front). Harm later than ``horizon_s`` (s after the alert) is not included.
        """
        braking = worlds.vehicles.braking_capacity_mps2
        command, least = -braking, np.zeros(worlds.n)
        for _ in range(1 if len(learners) == 1 else _ROUNDS):
            for vehicle in learners:
                candidates = -braking[:, vehicle, np.newaxis] * _BRAKING_SHARES
                harm = forecast(worlds, command, vehicle, candidates, horizon_s)[0 if self.harm_count == "first" else 1]
                choice = harm.argmin(axis=1)[:, np.newaxis]
                command[:, vehicle] = np.take_along_axis(candidates, choice, axis=1)[:, 0]
                least = np.take_along_axis(harm, choice, axis=1)[:, 0]
        return -least


REWARDS = {
    "harm": RewardParams(),
    "total-harm": RewardParams(harm_count="total"),
    "paper": RewardParams(harm=0.0, collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0),
}

Reward = str | RewardParams | Mapping[str, Any]  # a name, or settings


def reward_params(reward: Reward) -> RewardParams:
    """Convert a name in ``REWARDS`` or a mapping of settings to ``RewardParams``; return ``RewardParams`` unchanged.

    Raises ``UnknownName`` for an unknown name or setting, and ``InvalidInput`` for an invalid value.
    """
    if isinstance(reward, RewardParams):
        return reward
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise unknown_name("reward", reward, REWARDS)
        return REWARDS[reward]
    if not isinstance(reward, Mapping):
        raise InvalidInput(
            f"reward = {reward!r}: must be a name ({', '.join(REWARDS)}), a mapping such as {{'harm': 1.0}}, or"
            " RewardParams"
        )
    known = setting_names()
    for name in reward:
        if name not in known:
            raise unknown_name("setting of a reward", name, known)
    try:
        return RewardParams(**reward)
    except ValidationError as error:
        first = first_mistake(error)
        where = "" if isinstance(first.given, dict) else f" = {first.given!r}"
        raise InvalidInput(f"reward: {first.place.removeprefix('terms.')}{where}: {first.right}") from None


def setting_names() -> list[str]:
    """Return the keys that reward settings may have: the fields of ``RewardParams`` and the registered measures."""
    return [*RewardParams.model_fields, *own_terms()]
