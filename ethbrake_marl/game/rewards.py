"""Reward: a weighted sum of measures (``game.measures``): what is reported can be rewarded.

Built-in terms, for vehicle i and one step (the paper's section on the reward, with its printed defects repaired):

=========  =======================================================================================================
harm       minus the harm of the whole line in this step, each impact once (``harm_count``: first | total); or minus
           the change in this step of the amount that the vehicle's ``objective`` minimises
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

import warnings
from collections.abc import Mapping, Sequence
from operator import not_
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.model import UNSHOWN, FileModel, first_mistake, require
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.measures import BUILT_IN, MEASURES
from ethbrake_marl.game.objectives import Declared, Objective, check_declared, objectives_of
from ethbrake_marl.physics.forecast import forecast
from ethbrake_marl.physics.state import Floats, Worlds


class WithoutEffect(UserWarning):
    """Warning: a setting has no effect, for example an objective in a reward that gives harm the weight 0."""


def own_terms() -> list[str]:
    """Return the names of the registered measures, which are not built in; nothing is loaded."""
    return [name for name in MEASURES if name not in RewardParams.model_fields]


NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Finite = Annotated[float, Field(allow_inf_nan=False)]

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

Value = TypeVar("Value", float, Floats)

_BRAKING_SHARES = np.linspace(0.0, 1.0, 9)

_ROUNDS = 2  # of several learners


class RewardParams(FileModel):
    """Weights of the terms and their constants; a weight of 0 switches a term off.

    Args:
        harm, collision, risk, jerk, terminal, shaping: weights, at least 0, of these terms: harm of the line, all
            impacts, nearness of a collision, change of the command, an end without collision, and change of a
            potential. The head of the module has the formulas. harm must be given beside any other.
        harm_count: impacts that count, ``first`` of each pair or ``total``.
        objective: whose harm counts, one name or one for each vehicle; None: the scenario's.
        shaping_discount: the learner's own discount, in (0, 1].
        k_energy: weight of an impact's squared closing speed in the collision term.
        ttc_scale_s: time to collision at which the risk term falls, s.
        safety_buffer_m: distance kept free in the risk term, m.
        target_gap_m: gap below which the risk term rises, m.
        distance_slope_per_m: how steeply the risk term rises below that gap, 1/m.
        terms: weights of registered measures, which may be negative: a measure of harm gets a negative one.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random", reward=eb.RewardParams(harm=0.05, terminal=1.0))

    """

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
    # weights of registered measures; in a file or a mapping they may stand beside the others
    terms: dict[str, Finite] = Field(default_factory=dict, validate_default=True, exclude_if=not_)

    @model_validator(mode="before")
    @classmethod
    def _own_terms(cls, value: Any) -> Any:
        """Move the weights of registered measures that stand beside the other settings into ``terms``."""
        if not isinstance(value, dict):
            return value
        beside = {name: weight for name, weight in value.items() if name in own_terms()}
        if not beside:
            return value
        inside = value.get("terms", {})
        if not isinstance(inside, dict) or beside.keys() & inside.keys():
            raise ValueError("each weight of a registered measure is given once, beside the others or in terms")
        return {**{name: each for name, each in value.items() if name not in beside}, "terms": {**inside, **beside}}

    @field_validator("terms")
    @classmethod
    def _settled(cls, value: dict[str, float]) -> dict[str, float]:
        """Load the registered measures of ``terms`` and drop those with weight 0."""
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
        """Require an explicit weight of harm beside other terms, and a weight of harm above 0 for an objective.

        Harm weighs 1 by default, which must not happen unnoticed.
        """
        names = {*self.model_fields_set, *(self.terms if "terms" in self.model_fields_set else ())}
        beside = [name for name, weight in self.weights.items() if weight != 0.0 and name in names]
        right = f"is left out, and would weigh 1 beside {''.join(beside[:1])}; say harm: 1, or 0 for none"
        require(not beside or "harm" in names, ("harm",), UNSHOWN, right)
        right = "changes the term harm alone, whose weight is 0; give that a weight, or leave it out"
        require(self.objective is None or self.harm > 0.0, ("objective",), UNSHOWN, right)
        return self

    def weight(self, term: str) -> float:
        """Return the weight of the built-in term or registered measure ``term``; 0 if this reward does not have it."""
        weight: float = self.terms[term] if term in self.terms else self.__dict__.get(term, 0.0)
        return weight

    @property
    def weights(self) -> dict[str, float]:
        """Weight of every built-in term, and of the registered measures in ``terms``, by name."""
        return {name: self.weight(name) for name in (*BUILT_IN, *self.terms)}

    @property
    def counted(self) -> tuple[str, ...]:
        """Names of the terms with a weight other than 0: built-in terms in order, then registered measures."""
        return tuple(name for name, weight in self.weights.items() if weight != 0.0)

    def shared(self, harm: Value, safe_end: Value) -> dict[str, Value]:
        """Return the terms ``harm`` and ``terminal`` by name, as far as they count and are equal for all vehicles.

        With an objective the harm term differs between vehicles and is left out.

        Args:
            harm: harm of the step, of many worlds [n] or of one, m2/s2.
            safe_end: 1 where the episode ended without any collision, else 0.

        """
        terms = {}
        if self.harm > 0.0 and self.objective is None:
            terms["harm"] = -harm
        if self.terminal > 0.0:
            terms["terminal"] = safe_end
        return terms

    def weighted_sum(self, terms: Mapping[str, Floats], shape: tuple[int, ...]) -> Floats:
        """Return the reward of every vehicle, [n, N]: the sum of weight times term.

        ``terms``: values of each term by name, [n] or [n, N]; ``shape``: (n, N).
        """
        total = np.zeros(shape)
        for name, term in terms.items():
            total += self.weight(name) * (term if term.ndim == 2 else term[:, np.newaxis])
        return total

    def settled(self, of_scenario: Declared, vehicles: int) -> tuple[RewardParams, tuple[Objective, ...]]:
        """Return this reward with its field ``objective`` filled in, and the parsed objective of each vehicle.

        The objective is the reward's own, or else the scenario's. If all vehicles minimise everybody's harm (the usual
        case), the field is None and the tuple is empty. The same holds if harm has weight 0; then a warning
        (``WithoutEffect``) says that the objective changes nothing.

        Args:
            of_scenario: objective that the scenario declares.
            vehicles: number of vehicles in the line.

        Raises ``InvalidInput`` for an objective that does not fit the number of vehicles.

        """
        declared = of_scenario if self.objective is None else self.objective
        try:
            objectives = objectives_of(declared, vehicles)
        except InvalidInput as error:  # the scenario's was found to fit when it was made
            raise InvalidInput(f"reward: {error}") from None
        usual = all(objective.kind == "total" for objective in objectives)
        if not usual and self.harm == 0.0:
            what = f"the scenario's objective, {declared if isinstance(declared, str) else ', '.join(declared)},"
            warnings.warn(WithoutEffect(f"{what} changes nothing: this reward gives harm no weight"), stacklevel=2)
        if usual or self.harm == 0.0:
            return self.model_copy(update={"objective": None}), ()
        return self.model_copy(update={"objective": declared}), objectives

    def potential(self, worlds: Worlds, learners: Sequence[int], horizon_s: float) -> Floats:
        """Return the potential of the shaping term, [n] m2/s2: minus the least harm ahead that simple braking achieves.

        Each learner holds a constant deceleration from now on; all other vehicles brake fully. A single learner takes
        the best of nine shares of its capacity. Several learners begin with full braking and choose one after the
        other, front to rear, twice round; all get the same potential.

        Args:
            worlds: n worlds of N vehicles.
            learners: indices of the learners, from 0.
            horizon_s: end of the episode, s; harm until then counts, by ``harm_count``.

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
    """Return the ``RewardParams`` for a name in ``REWARDS``, a mapping of settings, or parameters (unchanged).

    Raises ``UnknownName`` for an unknown name or setting and ``InvalidInput`` for a value out of its range.
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
        where = "" if isinstance(first.given, dict) else f" = {first.given!r}"  # the whole of it is to be read there
        raise InvalidInput(f"reward: {first.place.removeprefix('terms.')}{where}: {first.right}") from None


def setting_names() -> list[str]:
    """Return the keys that a reward may have: fields of ``RewardParams``, then registered measures."""
    return [*RewardParams.model_fields, *own_terms()]
