"""Terms: named amounts of a step that can be rewarded, reported, or be components of a vector reward.

A term is a function ``term(before, step, after)`` of two states and the step between them (``State``, ``Step``). It
returns one number per world, [n], or per vehicle, [n, N]. Built-in terms, here for one vehicle in one step:

============  ==========================================================================================================
harm          minus the harm of the line; with an objective, minus the increase of the amount that the vehicle minimises
collision     minus ``sum k_energy w^2`` over every impact, with the closing speed w
risk          minus the sum over the vehicle's pairs of ``sigma(-TTC / tau) + sigma(k_d (d_target - d))``, with the gap
              d and ``TTC = max(d - d_safe, 0) / closing speed``; the first summand is 0 for a pair that does not close
jerk          minus the squared rate of change of the vehicle's force
terminal      1 at the end of an episode without any impact
push          minus the push of all contacts of the line (``motion.push``)
drove         minus the speed that the vehicle's engine alone gives it (``motion.forces.driving``)
still_moving  -1 if the episode ends at the horizon with a vehicle whose motion has a price
shaping       for learners: ``discount Phi(after) - Phi(before)``; Phi is minus the least harm that constant braking of
              the learners can reach (``episode.shaping``)
harm_K        minus the harm that vehicle_K bears
pair_J_K      minus the harm of the pair of vehicle_J and vehicle_K behind it
obstacle      minus the harm of impacts with the obstacle
============  ==========================================================================================================

``collision``, ``risk``, ``jerk`` and ``terminal`` are terms of the paper, without its misprints. In the formula of
``risk``, sigma is the logistic function; ``RewardParams`` has the constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import HarmCount, pair_amounts
from ethbrake_marl.episode.functions import call_function, check_finite_values, description_of
from ethbrake_marl.episode.objectives import Harm, Objective, amounts
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.episode.step import TRUNCATED, Step
from ethbrake_marl.errors import AlreadyExists, InvalidInput, unknown_name
from ethbrake_marl.motion.elementary import logistic
from ethbrake_marl.motion.layout import DROVE, MOVING, PUSHED, TOTAL, Floats
from ethbrake_marl.registry import Registry

TermFunction = Callable[[State, Step, State], Floats]


class Term(NamedTuple):
    """A registered term of rewards (``register_term``)."""

    name: str
    function: TermFunction
    unit: str
    meaning: str

    def value(self, before: State, step: Step, after: State) -> Floats:
        """Value in each world, [n], or of each vehicle, [n, N]; 0 in episodes that had ended before the step.

        Raises ``InvalidInput`` if the function fails, or if its result has another shape or is not finite.
        """
        what, arguments = f"term {self.name!r}", (before.read_only(), step, after.read_only())
        value = call_function(what, self.function, arguments, (after.n,), (after.n, after.vehicles))
        running = ~before.ended
        value = np.where(running if value.ndim == 1 else running[:, np.newaxis], value, 0.0)
        check_finite_values(what, value, after.time_s)
        return value


def register_term(name: str, function: TermFunction, *, unit: str = "1") -> None:
    """Register a term, which rewards can weigh and evaluations can report. Entry points: ``ethbrake_marl.terms``.

    The docstring of ``function`` describes the term. Raises ``AlreadyExists`` for a name in use, and ``InvalidInput``
    for a bad name or a missing docstring.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9``, ``_``, beginning with a letter, not ending in ``_`` and a number.
        function: ``function(before, step, after)`` returns [n] or [n, N].
        unit: unit of the value.

    """
    form = "a-z, 0-9 and _, beginning with a letter and not ending in _ and a number"
    meaning = description_of("term", name, function, r"(?!.*_[0-9]+\Z)[a-z][a-z0-9_]{0,63}", form)
    if name in BUILT_IN:
        raise AlreadyExists(f"term {name!r}: this name is already in use; give another name")
    term = Term(name, function, str(unit), meaning)
    TERMS.add(name, term, lambda registered: registered == term)


TERMS: Registry[Term] = Registry("term", "terms", register_term)

BUILT_IN = {  # name -> (unit, meaning)
    "harm": ("m2/s2", "minus the harm of the line, as harm_count and objective count it"),
    "collision": ("m2/s2", "minus k_energy times the harm of all impacts"),
    "risk": ("1", "minus the collision risk of the vehicle's pairs, from 0 to 1.5 (imminent) for each"),
    "jerk": ("m2/s6", "minus the squared rate of change of the vehicle's force"),
    "terminal": ("1", "1 at the end of an episode without any impact"),
    "push": ("m/s", "minus the push of all contacts of the line"),
    "drove": ("m/s", "minus the speed that the vehicle's engine alone gives"),
    "still_moving": ("1", "-1 for an end at the horizon with a vehicle whose motion has a price"),
    "shaping": ("m2/s2", "discounted potential after the step minus the potential before it"),
}


def collision(params: Any, before: State, step: Step, after: State) -> Floats:
    """Term collision (formula: module docstring), [n]; needs exact impacts. ``params`` are ``RewardParams``."""
    require(before, "the sum of the term collision", simulates=True)
    if isinstance(params.k_energy, float):
        return -params.k_energy * step.total_harm
    return -(pair_energies(params, after.vehicles) * (after.line[:, TOTAL] - before.line[:, TOTAL])).sum(axis=1)


def pair_energies(params: Any, vehicles: int) -> Floats:
    """``k_energy`` of every pair, [N + 1], from ``RewardParams``; the obstacle's pair has the first pair's value."""
    factors = params.k_energy if isinstance(params.k_energy, tuple) else (params.k_energy,) * (vehicles - 1)
    return np.array([factors[0], *factors, 0.0])


def jerk(before: State, step: Step, after: State) -> Floats:
    rate = (after.forces_mps2 - before.forces_mps2) / step.time_step_s
    return -rate * rate


def risk(params: Any, before: State, step: Step, after: State) -> Floats:
    """Term risk of each vehicle (formula: module docstring), [n, N]; ``params`` are ``RewardParams``."""
    closing = after.speeds_mps[:, 1:] - after.speeds_mps[:, :-1]
    room = np.maximum(after.gaps_m - params.safety_buffer_m, 0.0)
    approaching = closing > 0.0
    time_to_collision = room / np.where(approaching, closing, 1.0)
    urgency = np.where(approaching, logistic(-time_to_collision / params.ttc_scale_s), 0.0)
    pair_risk = -(urgency + logistic(params.distance_slope_per_m * (params.target_gap_m - after.gaps_m)))
    total = np.zeros(after.speeds_mps.shape)
    total[:, :-1] += pair_risk
    total[:, 1:] += pair_risk
    return total


def push(before: State, step: Step, after: State) -> Floats:
    """Term push, [n]: minus the push (m/s) of all contacts in the step, the contact with the obstacle included.

    Formula: ``motion.push``.
    """
    require(before, "the term push", simulates=True)
    return 0.0 - (after.line[:, PUSHED] - before.line[:, PUSHED]).sum(axis=1)


def drove(before: State, step: Step, after: State) -> Floats:
    """Term drove, [n, N]: minus the speed (m/s) that each vehicle's engine alone gives in the step.

    This speed is the integral of the force where it is positive (``motion.forces.driving``).
    """
    require(before, "the term drove", simulates=True)
    return 0.0 - (after.line[:, DROVE, :-1] - before.line[:, DROVE, :-1])


def still_moving(before: State, step: Step, after: State) -> Floats:
    """Term still_moving, [n]: -1 if the step ends at the horizon with motion that has a price, otherwise 0."""
    require(before, "the term still_moving", simulates=True)
    return 0.0 - step.out[TRUNCATED] * after.line[:, MOVING].any(axis=1)


def growth(objectives: Sequence[Objective], count: HarmCount, before: State, step: Step, after: State) -> Floats:
    """Term harm, [n, N]: minus the increase of the amount that each vehicle's objective minimises.

    ``objectives`` has one per vehicle.
    """
    return -amounts(objectives, before, after, count)


def component(name: str, count: HarmCount) -> TermFunction:
    """Function that computes the component ``harm_K``, ``pair_J_K`` or ``obstacle`` of a vector reward, [n]."""
    if name == "obstacle":
        return partial(_of_pair, 0, count)
    last_vehicle = int(name.rpartition("_")[2])
    if name.startswith("harm_"):
        return partial(_borne, last_vehicle - 1, count)  # columns of vehicles begin with Vehicle 1
    return partial(_of_pair, last_vehicle - 1, count)  # columns of pairs begin with the obstacle and Vehicle 1


def _borne(vehicle: int, count: HarmCount, before: State, step: Step, after: State) -> Floats:
    return 0.0 - Harm.of(_increase(count, before, after), after.car).borne[:, vehicle]


def _of_pair(pair: int, count: HarmCount, before: State, step: Step, after: State) -> Floats:
    return 0.0 - _increase(count, before, after)[0, :, pair]


def _increase(count: HarmCount, before: State, after: State) -> Floats:
    return pair_amounts(after.line, count) - pair_amounts(before.line, count)


def components_of(vector: Any, counted: Sequence[str], vehicles: int) -> tuple[str, ...]:
    """Names of the components of a vector reward.

    ``vector`` is a list of names, or ``"vehicles"`` for ``harm_1`` to ``harm_N``. ``counted`` are the terms of the
    reward, which can be components, too. Raises ``InvalidInput`` for an empty list or a repeated name, ``UnknownName``
    for an unknown name.
    """
    vehicle_components = [f"harm_{k + 1}" for k in range(vehicles)]
    if isinstance(vector, str) and vector == "vehicles":
        return tuple(vehicle_components)
    is_list_of_names = (
        isinstance(vector, Sequence) and not isinstance(vector, str) and all(isinstance(n, str) for n in vector)
    )
    if not is_list_of_names or not vector or len(set(vector)) < len(vector):
        raise InvalidInput(
            f"reward_vector = {vector!r}: must be 'vehicles', or a list of different components of harm, for instance"
            " ['harm_1', 'harm_2', 'harm_3']"
        )
    known = [*vehicle_components, *(f"pair_{k + 1}_{k + 2}" for k in range(vehicles - 1)), "obstacle", *counted]
    for name in vector:
        if name not in known:
            raise unknown_name("component of a reward", name, known)
    return tuple(vector)
