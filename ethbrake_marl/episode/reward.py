"""Rewards: weighted sums of terms (``episode.terms``)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from operator import not_
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import (
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from ethbrake_marl.episode.counts import ALL_IMPACTS, COUNTS, FIRST_IMPACTS, HONEST, HarmCount
from ethbrake_marl.episode.objectives import OBJECTIVES, Declared, objectives_of, parse_objective
from ethbrake_marl.episode.shaping import Shaping
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import SAFE_END, Step, StepSettings
from ethbrake_marl.episode.terms import (
    BUILT_IN,
    TERMS,
    TermFunction,
    collision,
    component,
    components_of,
    drove,
    growth,
    jerk,
    push,
    risk,
    still_moving,
)
from ethbrake_marl.errors import InvalidInput, UnknownName, unknown_name
from ethbrake_marl.files.model import UNSHOWN, FileModel, NonNegative, Positive, first_mistake, require
from ethbrake_marl.motion.layout import Floats, Ints


def _count(value: Any) -> HarmCount:
    try:
        return HarmCount.of(value, "")
    except InvalidInput as error:
        raise ValueError(str(error).rpartition(": ")[2]) from None


Count = Annotated[  # in files the name of a count
    HarmCount,
    PlainValidator(_count),
    PlainSerializer(lambda count: count.name),
    WithJsonSchema({"type": "string"}),
    Field(json_schema_extra=lambda schema: schema.update(enum=[*COUNTS], default=HONEST.name)),
]
Omitted = Annotated[float, Field(ge=0.0, allow_inf_nan=False, exclude_if=not_)]  # in files only if it is not 0
Finite = Annotated[float, Field(allow_inf_nan=False)]


class WithoutEffect(UserWarning):
    """A setting has no effect, such as an objective when the weight of harm is 0."""


def registered_terms() -> list[str]:
    return [name for name in TERMS if name not in RewardParams.model_fields]


class RewardParams(FileModel):
    """Weights of the terms of a reward, and their constants. A term of weight 0 is not computed.

    Args:
        harm: weight of the term harm. Required if you give any other weight.
        harm_count: what the term harm counts: ``honest``, ``first`` or ``total`` (``episode.counts``).
        objective: objective of all vehicles, or a list with one per vehicle; None: as in the scenario.
        collision, risk, jerk, terminal, push, drove, still_moving, shaping: weights of these terms (``episode.terms``).
        shaping_discount: discount in the term shaping, in (0, 1]; the learner's may not be larger (``check_gamma``).
        k_energy: factor of the term collision, or a list with one for each pair of vehicles, front to rear.
        ttc_scale_s: tau of the term risk, s.
        safety_buffer_m: d_safe of the term risk, m.
        target_gap_m: d_target of the term risk, m.
        distance_slope_per_m: k_d of the term risk, 1/m.
        terms: name of a registered term -> weight; a negative weight makes the term's value small.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random", reward=eb.RewardParams(harm=0.05, terminal=1.0))

    """

    harm: NonNegative = 1.0
    harm_count: Count = Field(default_factory=lambda: HONEST)  # a plain default cannot stand in a JSON Schema
    objective: str | Annotated[tuple[str, ...], Field(strict=False)] | None = None
    collision: NonNegative = 0.0
    risk: NonNegative = 0.0
    jerk: NonNegative = 0.0
    terminal: NonNegative = 0.0
    push: Omitted = 0.0
    drove: Omitted = 0.0
    still_moving: Omitted = 0.0
    shaping: NonNegative = 0.0
    shaping_discount: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    k_energy: NonNegative | Annotated[tuple[NonNegative, ...], Field(strict=False, min_length=1)] = 1.0
    ttc_scale_s: Positive = 1.0
    safety_buffer_m: NonNegative = 1.0
    target_gap_m: NonNegative = 3.0
    distance_slope_per_m: Positive = 1.0
    # a file may also write these weights next to the other settings
    terms: dict[str, Finite] = Field(default_factory=dict, validate_default=True, exclude_if=not_)

    @model_validator(mode="before")
    @classmethod
    def _collect_terms(cls, value: Any) -> Any:
        """Move weights of registered terms that stand next to the other settings into the mapping ``terms``."""
        if not isinstance(value, dict):
            return value
        outside_weights = {name: weight for name, weight in value.items() if name in registered_terms()}
        inside_weights = value.get("terms", {})
        if outside_weights and (not isinstance(inside_weights, dict) or outside_weights.keys() & inside_weights.keys()):
            raise ValueError(
                "write the weight of a registered term either in the mapping terms or next to the other settings, not"
                " in both places"
            )
        if not outside_weights:
            return value
        return {
            **{name: setting for name, setting in value.items() if name not in outside_weights},
            "terms": {**inside_weights, **outside_weights},
        }

    @field_validator("terms")
    @classmethod
    def _known_terms(cls, value: dict[str, float]) -> dict[str, float]:
        for name in value:
            if name not in registered_terms():
                raise unknown_name("term", name, registered_terms(), may_be_own=True)
        return {name: value[name] for name in sorted(value) if value[name] != 0.0 and TERMS[name]}  # loads the term

    @field_validator("objective", mode="before")
    @classmethod
    def _objective(cls, value: Any) -> Any:
        if value is not None:
            try:
                if isinstance(value, str):
                    parse_objective(value)  # how many weights it needs, the scenario says
                else:
                    objectives_of(value, len(value))
            except (InvalidInput, TypeError) as error:
                raise ValueError(str(error).removeprefix("objective: ")) from None
        return value

    @model_validator(mode="after")
    def _harm_is_meant(self) -> Self:
        """Refuse weights of other terms if no weight of harm is set, because its default is 1.

        Also refuse an objective if the weight of harm is 0.
        """
        names = {*self.model_fields_set, *(self.terms if "terms" in self.model_fields_set else ())}
        weighted_terms = [name for name, weight in self.weights.items() if weight != 0.0 and name in names]
        right = (
            f"must be given together with {''.join(weighted_terms[:1])}, because its default weight is 1; write harm:"
            " 1, or harm: 0 for a reward without harm"
        )
        require(not weighted_terms or "harm" in names, ("harm",), UNSHOWN, right)
        right = "has no effect, because it changes only the term harm, whose weight is 0; leave it out or give a weight"
        require(self.objective is None or self.harm > 0.0, ("objective",), UNSHOWN, right)
        return self

    def right_gamma(self, gamma: float) -> str:
        """What the discount ``gamma`` of a learner must be, if it is too large for the shaping; otherwise empty."""
        if self.shaping == 0.0 or gamma <= self.shaping_discount:
            return ""
        return (
            f"must be at most {self.shaping_discount:g}, the reward's shaping_discount: a larger discount of the"
            " learner pays for states of large predicted harm"
        )

    def check_gamma(self, gamma: float, what: str) -> None:
        """Raise ``InvalidInput`` if the discount ``gamma`` of a learner is too large; ``what`` begins the message."""
        if right := self.right_gamma(gamma):
            raise InvalidInput(f"{what} = {gamma:g}: {right}")

    @property
    def weights(self) -> dict[str, float]:
        return {**{name: getattr(self, name) for name in BUILT_IN}, **self.terms}


REWARDS = {
    "shaped": RewardParams(harm=0.05, shaping=0.05, shaping_discount=0.99),
    "honest": RewardParams(),
    "first-impact-harm": RewardParams(harm_count=FIRST_IMPACTS),
    "total-harm": RewardParams(harm_count=ALL_IMPACTS),
    "paper-reward": RewardParams(harm=0.0, harm_count=FIRST_IMPACTS, collision=1.0, risk=0.1, jerk=1e-5, terminal=10.0),
}
ENDED = {  # names of rewards that are refused -> what to write
    "paper": "paper-reward for its four terms, or first-impact-harm for its count",
    "harm": "first-impact-harm, total-harm or honest: a weight of the term harm alone counts the honest cost",
}
Reward = str | RewardParams | Mapping[str, Any]  # a name, or settings


def reward_params(reward: Reward) -> RewardParams:
    """Settings of a reward from its name or a mapping. Raises ``UnknownName`` or ``InvalidInput``."""
    if isinstance(reward, RewardParams):
        return reward
    if isinstance(reward, str):
        if reward in ENDED:
            raise UnknownName(f"reward {reward!r} has ended; write {ENDED[reward]}")
        if reward not in REWARDS:
            raise unknown_name("reward", reward, REWARDS)
        return REWARDS[reward]
    if not isinstance(reward, Mapping):
        raise InvalidInput(
            f"reward = {reward!r}: must be a name ({', '.join(REWARDS)}), a mapping such as {{'harm': 1.0}}, or"
            " RewardParams"
        )
    known = [*RewardParams.model_fields, *registered_terms()]
    for name in reward:
        if name not in known:
            raise unknown_name("term or setting of a reward", name, known, may_be_own=True)
    try:
        return RewardParams(**reward)
    except ValidationError as error:
        first = first_mistake(error)
        where = "" if isinstance(first.value, dict) else f" = {first.value!r}"
        raise InvalidInput(f"reward: {first.place.removeprefix('terms.')}{where}: {first.right}") from None


class Rewarding(NamedTuple):
    """A reward, prepared for use after each step: its parameters, and the functions for those of its terms that the
    compiled step does not compute.
    """

    params: RewardParams
    counted: tuple[str, ...]  # names of the terms whose weight is not 0
    reported: tuple[str, ...]  # these terms, and others whose value infos contain
    terms: tuple[tuple[str, float, TermFunction], ...]  # name, weight (0: only a component or in infos) and function
    shaping: Shaping | None
    components: tuple[str, ...]  # of a vector reward

    @classmethod
    def of(
        cls,
        reward: Reward,
        objective: Declared,
        vehicles: int,
        learners: Ints,
        times: tuple[float, float],
        vector: Any,
        report: Sequence[str] = (),
    ) -> tuple[Rewarding, StepSettings]:
        """The reward, and the settings of a step, which contain the weights that the compiled step uses.

        ``objective`` is the scenario's objective. ``times`` are time step and horizon (s). ``vector`` lists the
        components of a vector reward, or is None. ``report`` names terms whose values the infos contain, even if they
        have no weight. Warns (``WithoutEffect``) if the objective has no effect.
        """
        params = reward_params(reward)
        declared = objective if params.objective is None else params.objective
        try:
            objectives = objectives_of(declared, vehicles)
        except InvalidInput as error:
            raise InvalidInput(f"reward: {error}") from None
        line_only = all(vehicle_objective.kind is OBJECTIVES["total"] for vehicle_objective in objectives)
        if isinstance(report, str) or not isinstance(report, Sequence):
            raise InvalidInput(f"report = {report!r}: must be a list of names of terms, such as ['risk', 'jerk']")
        for name in report:
            if name not in (*BUILT_IN, *registered_terms()):
                raise unknown_name("term", name, (*BUILT_IN, *registered_terms()), may_be_own=True)
        if not line_only and params.harm == 0.0 and "harm" not in report:
            what = declared if isinstance(declared, str) else ", ".join(declared)
            warnings.warn(
                WithoutEffect(
                    f"the scenario's objective, {what}, has no effect: the weight of harm in this reward is 0"
                ),
                stacklevel=2,
            )
            line_only = True
        if isinstance(params.k_energy, tuple) and len(params.k_energy) != vehicles - 1:
            raise InvalidInput(
                f"reward: k_energy has {len(params.k_energy)} entries; must be a number, or have one for each of the"
                f" {vehicles - 1} pairs of vehicles"
            )
        harm = params.harm if line_only else 0.0  # the compiled step rewards the line's harm; `growth` any other
        settings = StepSettings(learners, *times, harm, params.terminal, params.harm_count)
        counted = tuple(name for name, weight in params.weights.items() if weight != 0.0)
        reported = tuple(dict.fromkeys((*counted, *report)))
        components = () if vector is None else components_of(vector, counted, vehicles)
        functions: dict[str, TermFunction] = {
            "harm": partial(growth, objectives, params.harm_count),
            "collision": partial(collision, params),
            "risk": partial(risk, params),
            "jerk": jerk,
            "push": push,
            "drove": drove,
            "still_moving": still_moving,
            **{name: TERMS[name].value for name in reported if name not in BUILT_IN},
            **{name: component(name, params.harm_count) for name in components if name not in counted},
        }
        needed_terms = {*reported, *components} - ({"harm"} if line_only else set())
        terms = tuple(
            (n, params.weights.get(n, 0.0), function) for n, function in functions.items() if n in needed_terms
        )
        shaping = Shaping(settings, params.shaping_discount) if "shaping" in reported else None
        return cls(params, counted, reported, terms, shaping, components), settings

    @property
    def is_compiled(self) -> bool:
        return not self.terms and self.shaping is None and not self.components

    def complete(self, before: State, step: Step, after: State) -> tuple[State, Step]:
        """The state ``after`` with the reward's new memory, and the step with the complete reward."""
        values = {name: function(before, step, after) for name, _, function in self.terms}
        if self.shaping is not None:
            values["shaping"], memory = self.shaping.value(before, after)
            after = State(*after[:5], {**after.memories, "shaping": memory})
        extra = np.zeros(step.reward.shape)
        for name, weight, _ in self.terms:
            if weight:
                extra += weight * _wide(values[name])
        if self.params.shaping:
            extra += self.params.shaping * values["shaping"]
        if self.terms:
            extra[before.ended] = 0.0
        reward_terms = {**self.shared(step), **values}
        step = Step(step.reward + extra, step.out, step.time_step_s, reward_terms)
        if self.components:
            step = step._replace(terms={name: reward_terms[name] for name in reward_terms if name in self.reported})
            vector = np.stack(
                [np.broadcast_to(_wide(reward_terms[name]), extra.shape) for name in self.components], axis=2
            )
            vector[before.ended] = 0.0
            step = step._replace(vector=vector)
        return after, step

    def shared(self, step: Step) -> dict[str, Floats]:
        """Values of the terms that the compiled step computes, name -> [n]."""
        values = {"harm": -step.cost} if "harm" in self.reported else {}
        if "terminal" in self.reported:
            values["terminal"] = step.out[SAFE_END]
        return values


def _wide(value: Floats) -> Floats:
    return value if value.ndim == 2 else value[:, np.newaxis]
