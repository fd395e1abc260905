"""Reward: a weighted sum of named terms, all computed from the ledger and the state that are also reported.

Terms, for vehicle i and one step (the paper's section on the reward, with its printed defects repaired):

=========  =======================================================================================================
harm       minus the harm of the whole line in this step, each impact once (``harm_count``: first | total); or by how
           much the step raised what the vehicle's ``objective`` makes of the harm so far
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

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import not_
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.model import UNSHOWN, FileModel, first_mistake, require
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.objectives import Declared, Objective, check_declared, objectives_of
from ethbrake_marl.physics.elementary import logistic
from ethbrake_marl.physics.forecast import forecast
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.registry import Registry

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class WithoutEffect(UserWarning):
    """Something that was given changes nothing here."""


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """What the terms of one step are computed from, for n worlds of N vehicles (P pairs); read it, do not change it.

    Vehicles are counted from 0, the front one.
    """

    first_impact_harm: Floats  # [n] of the whole line in this step, m2/s2
    total_harm: Floats  # [n] likewise, every impact counted
    safe_end: Bools  # [n] the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] after the step
    speeds_mps: Floats  # [n, N] after the step
    command_mps2: Floats  # [n, N] in force after the step
    previous_mps2: Floats  # [n, N] in force before it
    time_step_s: float
    time_s: Floats  # [n] since the alert, after the step
    braking_capacity_mps2: Floats  # [n, N] largest deceleration
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration
    latency_s: Floats  # [n, N] from when on commands take effect
    mass_t: Floats  # [n, N]
    learners: Ints  # [L] the vehicles that learn

    def built_in(self, terms: Sequence[Term], params: RewardParams) -> dict[str, Floats]:
        """Built-in terms that need the motion, each [n, N]."""
        return {term.name: term.function(params, self) for term in terms if term.function is not None}

    def registered(self, terms: Sequence[Term], counts: Bools, steps: Ints) -> dict[str, Floats]:
        """Registered terms, each [n, N]; see ``checked_term``. They cannot change what they are given."""
        for name in StepOutcome.__slots__:
            if isinstance(given := getattr(self, name), np.ndarray):
                given.flags.writeable = False
        return {term.name: checked_term(term, self, counts, steps) for term in terms}


TermFunction = Callable[[StepOutcome], Floats]


@dataclass(frozen=True, slots=True)
class Term:
    """One line of the table."""

    name: str
    meaning: str
    unit: str
    function: Callable[..., Floats] | None  # of the reward's settings and the step; None: the engine adds it itself
    registered: bool = False  # by somebody else; its function takes the step alone


def register_term(name: str, function: TermFunction, *, unit: str = "1") -> None:
    """Make ``name`` a term of rewards: a weight in a recipe, in ``RewardParams(terms=...)``, a column of infos.

    An installed package does the same with an entry point of the group ``ethbrake_marl.rewards``: its function, or a
    ``Part`` of it.

    Args:
        name: lower case letters, digits and ``_``; the key of its weight beside ``harm`` and ``jerk``.
        function: from a ``StepOutcome`` to the term before its weight, of worlds [n] (shared by all vehicles), of the
            learners [n, L], or of all vehicles [n, N]; its docstring says what it means.
        unit: of the term.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another term of that name, and
    ``InvalidInput`` for a name that is none, or a function without a docstring.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"reward term {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"reward term {name!r}: needs a function with a docstring that says what it means")
    if name in RewardParams.model_fields:
        raise AlreadyExists(f"reward term {name!r} is registered already; give another name")
    term = Term(name, " ".join((function.__doc__ or "").split()), str(unit), function, registered=True)
    TERMS.add(name, term, lambda other: other == term)


def own_terms() -> list[str]:
    """Names of those that are not built in; nothing is loaded."""
    return [name for name in TERMS if name not in RewardParams.model_fields]


def checked_term(term: Term, step: StepOutcome, counts: Bools, steps: Ints) -> Floats:
    """A registered term as [n, N]; 0 in rows that do not count.

    ``steps`` [n] is how many steps each world has made, for the message: ``InvalidInput`` names the term, and the
    world, vehicle and step of a number that is not finite, or the shape that does not fit.
    """
    assert term.function is not None
    try:
        value = np.asarray(term.function(step))
    except (Exception, SystemExit) as error:
        raise InvalidInput(f"reward term {term.name!r}, at step {int(steps.max())}: {describe_error(error)}") from error
    n, vehicles = step.speeds_mps.shape
    own = (n, len(step.learners))
    if value.dtype.kind not in "fiub" or value.shape not in ((n,), own, (n, vehicles)):
        raise InvalidInput(
            f"reward term {term.name!r}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({n},),"
            f" {own} (one per learner) or {(n, vehicles)} (one per vehicle)"
        )
    spread = np.zeros((n, vehicles))
    if value.ndim == 1:
        spread[:] = value[:, np.newaxis]
    else:
        spread[:, slice(None) if value.shape == (n, vehicles) else step.learners] = value
    spread[~counts] = 0.0
    if not np.isfinite(spread).all():
        world, vehicle = np.argwhere(~np.isfinite(spread))[0]
        raise InvalidInput(
            f"reward term {term.name!r}: is {spread[world, vehicle]} for vehicle_{vehicle + 1} in world {world} at step"
            f" {steps[world]}; must be finite"
        )
    return spread


NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

Value = TypeVar("Value", float, Floats)

_BRAKING_SHARES = np.linspace(0.0, 1.0, 9)

_ROUNDS = 2  # of several learners


class RewardParams(FileModel):
    """Weights of the terms and their constants; a weight of 0 switches a term off.

    Args:
        harm, collision, risk, jerk, terminal, shaping: weights, at least 0, of the terms that the module's head lists;
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
    terms: dict[str, NonNegative] = Field(default_factory=dict, validate_default=True, exclude_if=not_)

    @model_validator(mode="before")
    @classmethod
    def _own_terms(cls, value: Any) -> Any:
        """Weights of registered terms that stand beside the others go where they belong."""
        if not isinstance(value, dict):
            return value
        beside = {name: weight for name, weight in value.items() if name in own_terms()}
        if not beside:
            return value
        inside = value.get("terms", {})
        if not isinstance(inside, dict) or beside.keys() & inside.keys():
            raise ValueError("each weight of a registered term is given once, beside the others or in terms")
        return {**{name: each for name, each in value.items() if name not in beside}, "terms": {**inside, **beside}}

    @field_validator("terms")
    @classmethod
    def _settled(cls, value: dict[str, float]) -> dict[str, float]:
        """Those that count, which are loaded."""
        for name in value:
            if name not in own_terms():
                raise unknown_name("reward term", name, own_terms(), may_be_own=True)
        return {name: value[name] for name in sorted(value) if value[name] > 0.0 and TERMS[name]}

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
        right = f"is left out, and would weigh 1 beside {''.join(beside[:1])}; say harm: 1, or 0 for none"
        require(not beside or "harm" in given, ("harm",), UNSHOWN, right)
        right = "changes the term harm alone, whose weight is 0; give that a weight, or leave it out"
        require(self.objective is None or self.harm > 0.0, ("objective",), UNSHOWN, right)
        return self

    def weight(self, term: str) -> float:
        """The weight of a term of the table, registered or not."""
        found: float = self.terms[term] if term in self.terms else self.__dict__.get(term, 0.0)
        return found

    @property
    def weights(self) -> dict[str, float]:
        """The weight of every built-in term, and of its own."""
        return {name: self.weight(name) for name in (*(term.name for term in _BUILT_IN), *self.terms)}

    @property
    def counted(self) -> tuple[str, ...]:
        """Names of the terms that this reward counts, in the order of the table."""
        return tuple(name for name, weight in self.weights.items() if weight > 0.0)

    @property
    def moving(self) -> list[Term]:
        """The built-in terms that need the motion, of those that this reward counts: collision, risk, jerk."""
        return [TERMS[name] for name in self.counted if TERMS[name].function and not TERMS[name].registered]

    @property
    def registered(self) -> list[Term]:
        """The registered terms that this reward counts."""
        return [TERMS[name] for name, weight in self.terms.items() if weight > 0.0]

    def shared(self, harm: Value, safe_end: Value) -> dict[str, Value]:
        """The terms that all vehicles share and that need no more than the step's facts, of many worlds [n] or of one.

        ``harm`` as counted; ``safe_end`` is 1 or 0. With an objective other than everybody's harm, harm is not shared.
        """
        terms = {}
        if self.harm > 0.0 and self.objective is None:
            terms["harm"] = -harm
        if self.terminal > 0.0:
            terms["terminal"] = safe_end
        return terms

    def weighted_sum(self, terms: Mapping[str, Floats], shape: tuple[int, ...]) -> Floats:
        """Reward of every vehicle, [n, N]."""
        total = np.zeros(shape)
        for name, term in terms.items():
            total += self.weight(name) * term
        return total

    def settled(self, of_scenario: Declared, vehicles: int) -> tuple[RewardParams, tuple[Objective, ...]]:
        """The reward with its objective settled (the scenario's where it has none), and that of each vehicle.

        Everybody's harm alike, the usual one, is ``None`` and no objectives: it needs no telling apart. So is any where
        harm weighs nothing, with a warning (``WithoutEffect``).
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
        """Minus the least harm ahead, [n], that was found with a constant deceleration of each learner from now on.

        All others brake fully; harm is what ``harm_count`` counts, from now to the horizon, in the engine's physics.
        One learner takes the best of nine shares of its capacity. Several begin with full braking and choose so one
        after the other, front to rear, twice round, each given what the others have chosen: all have the same
        potential.
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


def _collision(params: RewardParams, step: StepOutcome) -> Floats:
    return (-params.k_energy * step.total_harm).repeat(step.speeds_mps.shape[1]).reshape(step.speeds_mps.shape)


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


_BUILT_IN = (
    Term("harm", "minus the harm of the step, as `harm_count` and `objective` count it", "m2/s2", None),
    Term("collision", "minus `k_energy` times the harm of every impact of the step", "m2/s2", _collision),
    Term("risk", "minus how near and how soon a collision of each own pair is, 0 to 2 a pair", "1", _risk),
    Term("jerk", "minus the squared rate of change of the own command", "m2/s6", _jerk),
    Term("terminal", "1 when an episode ends without any collision", "1", None),
    Term("shaping", "difference of potentials: minus the least harm ahead, for learners", "m2/s2", None),
)

TERMS: Registry[Term] = Registry("reward term", "rewards", register_term, {term.name: term for term in _BUILT_IN})

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
        given = "" if isinstance(first.given, dict) else f" = {first.given!r}"  # the whole of it is to be read there
        raise InvalidInput(f"reward: {first.place.removeprefix('terms.')}{given}: {first.right}") from None


def setting_names() -> list[str]:
    """The keys that a reward may have: its own, then the registered terms."""
    return [*RewardParams.model_fields, *own_terms()]
