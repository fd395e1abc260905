"""The settings of a reward: weights of its terms, their constants, which impacts count and whose harm."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Annotated, Any, NoReturn, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ethbrake_marl.errors import InvalidInput, WithoutEffect, unknown_name
from ethbrake_marl.files.messages import first_mistake
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.objectives import Declared, Objective, check_declared, objectives_of
from ethbrake_marl.rewards.registry import SETTINGS, TERMS, registered_terms, settled_weights

NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _none(value: dict[str, float]) -> bool:
    return not value


def _refuse(key: str, right: str) -> NoReturn:
    raise PydanticCustomError("reward", "{right}", {"right": right, "value": "", "at": (key,)})


class RewardParams(BaseModel):
    """Weights of the terms and their constants; a weight of 0 switches a term off.

    Args:
        harm, collision, risk, jerk, terminal, shaping: weights, at least 0, of the terms that the folder's head lists;
            harm must be given beside any other.
        harm_count: impacts that count, ``first`` of each pair or ``total``.
        objective: whose harm counts, one name or one for each vehicle; None: the scenario's.
        shaping_discount: the learner's own discount, in (0, 1].
        k_energy: weight of an impact's squared closing speed in the collision term.
        ttc_scale_s: time to collision at which the risk term falls, s.
        safety_buffer_m: distance kept free in the risk term, m.
        target_gap_m: gap below which the risk term rises, m.
        distance_slope_per_m: how steeply it does, 1/m.
        terms: weights, at least 0, of registered terms.

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
    # weights of terms that somebody registered; in a file or a mapping they may stand beside the others
    terms: dict[str, NonNegative] = Field(default_factory=dict, validate_default=True, exclude_if=_none)

    @model_validator(mode="before")
    @classmethod
    def _own_terms(cls, value: Any) -> Any:
        """Weights of registered terms that stand beside the others go where they belong."""
        if not isinstance(value, dict):
            return value
        beside = {name: weight for name, weight in value.items() if name in registered_terms()}
        if not beside:
            return value
        inside = value.get("terms", {})
        if not isinstance(inside, dict) or beside.keys() & inside.keys():
            raise ValueError("each weight of a registered term is given once, beside the others or in terms")
        return {**{name: each for name, each in value.items() if name not in beside}, "terms": {**inside, **beside}}

    @field_validator("terms")
    @classmethod
    def _settled(cls, value: dict[str, float]) -> dict[str, float]:
        return settled_weights(value)

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
        """Harm weighs 1 by default, and an objective is about harm: neither may hold without being meant."""
        given = {*self.model_fields_set, *(self.terms if "terms" in self.model_fields_set else ())}
        beside = [name for name, weight in self.weights.items() if weight > 0.0 and name in given]
        if beside and "harm" not in given:
            _refuse("harm", f"is left out, and would weigh 1 beside {beside[0]}; say harm: 1, or 0 for none")
        if self.objective is not None and self.harm == 0.0:
            _refuse("objective", "changes the term harm alone, whose weight is 0; give that a weight, or leave it out")
        return self

    def weight(self, term: str) -> float:
        """The weight of a term of the table, registered or not."""
        found: float = self.terms[term] if term in self.terms else self.__dict__.get(term, 0.0)
        return found

    @property
    def weights(self) -> dict[str, float]:
        """The weight of every term."""
        return {name: self.weight(name) for name in TERMS}


SETTINGS.update(RewardParams.model_fields)

REWARDS = {
    "harm": RewardParams(),
    "total-harm": RewardParams(harm_count="total"),
    "paper": RewardParams(harm=0.0, collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0),
}


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


def setting_names() -> list[str]:
    """The keys that a reward may have: its own, then the registered terms."""
    return [*RewardParams.model_fields, *registered_terms()]


def resolved_objective(
    params: RewardParams, of_scenario: Declared, vehicles: int
) -> tuple[RewardParams, tuple[Objective, ...]]:
    """The reward with its objective settled (the scenario's where it has none), and that of each vehicle.

    Everybody's harm alike, the usual one, is ``None`` and no objectives: it needs no telling apart. So is any where
    harm weighs nothing, with a warning (``WithoutEffect``).
    Raises ``InvalidInput`` for an objective that does not fit the number of vehicles.
    """
    declared = of_scenario if params.objective is None else params.objective
    try:
        objectives = objectives_of(declared, vehicles)
    except InvalidInput as error:  # the scenario's was found to fit when it was made
        raise InvalidInput(f"reward: {error}") from None
    usual = all(objective.kind == "total" for objective in objectives)
    if not usual and params.harm == 0.0:
        what = f"the scenario's objective, {declared if isinstance(declared, str) else ', '.join(declared)},"
        warnings.warn(WithoutEffect(f"{what} changes nothing: this reward gives harm no weight"), stacklevel=2)
    if usual or params.harm == 0.0:
        return params.model_copy(update={"objective": None}), ()
    return params.model_copy(update={"objective": declared}), objectives


def _from_settings(settings: Mapping[str, Any]) -> RewardParams:
    known = setting_names()
    for name in settings:
        if name not in known:
            raise unknown_name("setting of a reward", name, known)
    try:
        return RewardParams(**settings)
    except ValidationError as error:
        first = first_mistake(error)
        given = "" if isinstance(first.given, dict) else f" = {first.given!r}"  # the whole of it is to be read there
        raise InvalidInput(f"reward: {first.place.removeprefix('terms.')}{given}: {first.right}") from None
