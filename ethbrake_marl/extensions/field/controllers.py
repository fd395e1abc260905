"""Controllers from the literature: car-following models, the driver models of UN R157, emergency braking.

A *law* is the formula of a controller. The formula computes a command from the motion of the vehicle itself and of the
vehicle ahead. ``LAWS`` lists all laws with their parameters and sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.agents.received import Received
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.physics.messages import ACCELERATION, MEASURED, Messages, refuse_untold
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.registry import Part

_TOUCHING_M = 1e-6  # least gap for a law, because laws divide by the gap

_SAME_S = 1e-9  # tolerance for rounding of an elapsed time (s)


class Parameters:
    """Parameters of one law as attributes with the names in ``LAWS``, in SI units."""

    def __init__(self, **values: float) -> None:
        self.__dict__.update(values)

    def __getattr__(self, name: str) -> float:
        raise AttributeError(name)


class Seen(NamedTuple):
    """Motion of one vehicle in ``n`` worlds, and what it knows from sensors or messages about the vehicle ahead.

    If information about the vehicle ahead is old, its motion is extrapolated to the present time with its last known
    acceleration. Vehicle 1 treats an obstacle like a vehicle ahead. If nothing is ahead, or if the vehicle knows
    nothing about the vehicle ahead, the gap is infinite.
    """

    gap_m: Floats  # [n] gap to the vehicle or obstacle ahead; infinite if nothing is ahead
    speed_mps: Floats  # [n] own speed
    front_mps: Floats  # [n] speed of the vehicle or obstacle ahead
    front_mps2: Floats  # [n] present commanded acceleration of the vehicle ahead
    own_mps2: Floats  # [n] own present commanded acceleration
    step_s: float  # time until the next decision (s)

    @classmethod
    def of(cls, worlds: Worlds, vehicle: int, step_s: float) -> Seen:
        """Return the present motion of ``vehicle``, and what it knows about the vehicle ahead.

        ``step_s`` is the time between two decisions, s.
        """
        received, own, none = Received.by(worlds, vehicle), worlds.command_mps2[:, vehicle], np.zeros(worlds.n)
        gap, front, force = received.obstacle_m, none, none
        if vehicle:
            k = vehicle - 1
            age = worlds.time_s - received.at_s[:, k]
            then, force = received.speed_mps[:, k], received.command_mps2[:, k]
            brakes = force < 0.0
            age = np.minimum(age, np.where(brakes, np.maximum(then, 0.0) / np.where(brakes, -force, 1.0), np.inf))
            front = np.where(age > 0.0, np.maximum(then + force * age, 0.0), then)
            known = received.known[:, k] & received.pieces[:, k, ACCELERATION]
            gap = np.where(known, received.place_m[:, k] + 0.5 * (then + front) * age, np.inf)
        return cls(np.maximum(gap, _TOUCHING_M), worlds.speeds_mps[:, vehicle], front, force, own, step_s)

    @property
    def closing_mps(self) -> Floats:
        """Speed at which the gap to the vehicle ahead closes, [n] m/s; negative if the gap opens."""
        return self.speed_mps - self.front_mps

    @property
    def until_contact_s(self) -> Floats:
        """Time until contact with the vehicle ahead at present speeds, [n] s; infinite if the gap does not close."""
        closing = self.closing_mps
        return np.where(closing > 0.0, self.gap_m / np.where(closing > 0.0, closing, 1.0), np.inf)

    @property
    def headway_s(self) -> Floats:
        """Gap to the vehicle ahead / speed of this vehicle, [n] s; infinite if this vehicle's speed is not above 0."""
        return np.where(self.speed_mps > 0.0, self.gap_m / np.where(self.speed_mps > 0.0, self.speed_mps, 1.0), np.inf)

    def built_up(self, wanted_mps2: Floats, rate_mps3: float) -> Floats:
        """Return the command for the next time step, [n] m/s2, with a limited growth of the deceleration.

        ``wanted_mps2`` [n] is the acceleration of the law; ``rate_mps3`` is the largest growth per second, m/s3.
        """
        return np.maximum(wanted_mps2, np.minimum(self.own_mps2, 0.0) - rate_mps3 * self.step_s)


def _idm(seen: Seen, p: Parameters) -> Floats:
    wanted = p.s0 + np.maximum(
        0.0, seen.speed_mps * p.T + seen.speed_mps * seen.closing_mps / (2 * math.sqrt(p.a * p.b))
    )
    return p.a * (1.0 - np.square(np.square(seen.speed_mps / p.v0)) - np.square(wanted / seen.gap_m))


def _is_free(seen: Seen, p: Parameters) -> Bools:
    return seen.gap_m > p.free * np.maximum(seen.speed_mps, 1.0) + p.s0


def _acc(seen: Seen, p: Parameters) -> Floats:
    gap = p.gap * (seen.gap_m - p.s0 - p.T * seen.speed_mps) - p.rate * seen.closing_mps
    return np.where(_is_free(seen, p), p.speed * (p.v0 - seen.speed_mps), gap)


def _cacc(seen: Seen, p: Parameters) -> Floats:
    wide = seen.gap_m - p.s0 - p.T * seen.speed_mps
    rate = -seen.closing_mps - p.T * seen.own_mps2
    keeps, closes = p.gap * wide + p.rate * rate, 0.005 * wide + 0.05 * rate
    change = np.where(wide < 0.0, p.gap * wide + 0.05 * rate, np.where(wide < 0.2, keeps, closes))
    return np.where(_is_free(seen, p), p.speed * (p.v0 - seen.speed_mps), change / seen.step_s)


def _safe_distance(seen: Seen, p: Parameters) -> Floats:
    speed = np.maximum(seen.speed_mps, 0.0)
    ahead = np.square(np.maximum(seen.front_mps, 0.0)) / (2.0 * p.b_max)
    way = speed * p.rho + 0.5 * p.a * p.rho * p.rho + np.square(speed + p.rho * p.a) / (2.0 * p.b_min)
    return np.maximum(way - ahead, 0.0)


def _rss(seen: Seen, p: Parameters) -> Floats:
    return np.where(seen.gap_m < _safe_distance(seen, p), -p.b_min, 0.0)


def _human(seen: Seen, p: Parameters) -> Floats:
    return seen.built_up(np.full_like(seen.gap_m, -p.most), p.jerk)


def _human_notices(seen: Seen, p: Parameters) -> Bools:
    brakes = (seen.front_mps2 < -p.front) & (seen.headway_s < p.headway)
    return brakes | (seen.until_contact_s < p.ttc)


def _share(distance: Floats, safe: Floats, unsafe: Floats) -> Floats:
    """Return the danger [n]: 0 for a ``distance`` above ``safe``, 1 below ``unsafe``, and linear in between."""
    between = (safe - distance) / np.where(safe > unsafe, safe - unsafe, 1.0)
    return np.where(distance > safe, 0.0, np.where(distance < unsafe, 1.0, between))


def fuzzy(seen: Seen, p: Parameters) -> tuple[Floats, Floats]:
    """Return the proactive and the critical criterion of the fuzzy safety model of UN R157, each [n].

    Each criterion is a number from 0 (no danger) to 1 (full danger). ``p`` are parameters of the law ``r157_fsm``.
    """
    speed, front = np.maximum(seen.speed_mps, 0.0), np.maximum(seen.front_mps, 0.0)
    ahead, reacting = np.square(front) / (2.0 * p.b_front), speed * p.reaction
    proactive = _share(
        seen.gap_m - p.margin,
        reacting + np.square(speed) / (2.0 * p.b_min) - ahead + p.margin_safe,
        reacting + np.square(speed) / (2.0 * p.b_max) - ahead,
    )
    own = np.maximum(seen.own_mps2, -p.b_min)
    after = speed + p.reaction * own - front
    way = (speed + 0.5 * own * p.reaction - front) * p.reaction
    critical = _share(seen.gap_m, way + np.square(after) / (2.0 * p.b_min), way + np.square(after) / (2.0 * p.b_max))
    slows = (after < 0.0) & (own < 0.0)  # slower than the vehicle ahead after the reaction time
    until = np.square(speed - front) / (2.0 * np.where(slows, -seen.own_mps2, 1.0))
    critical = np.where(slows, np.where(seen.gap_m < until, 1.0, 0.0), critical)
    return proactive, np.where(speed > front, critical, 0.0)


def _fsm_notices(seen: Seen, p: Parameters) -> Bools:
    proactive, critical = fuzzy(seen, p)
    return (seen.closing_mps > 0.0) & (proactive + critical > 0.0)


def _fsm(seen: Seen, p: Parameters) -> Floats:
    proactive, critical = fuzzy(seen, p)
    wanted = np.where(critical > 0.0, critical * (p.b_max - p.b_min) + p.b_min, proactive * p.b_min)
    return seen.built_up(-np.minimum(wanted, p.most), p.jerk)


def _aeb(seen: Seen, p: Parameters) -> Floats:
    required = np.square(np.maximum(seen.closing_mps, 0.0)) / (2.0 * seen.gap_m)
    return np.where((seen.until_contact_s < p.ttc) | (required > p.required), -np.inf, 0.0)


@dataclass(frozen=True, slots=True)
class Law:
    """One controller from the literature: a formula for the acceleration, its parameters and its source."""

    about: str  # name of the controller
    source: str  # publication of the formula
    parameters: Mapping[str, float]  # default value of each parameter, in SI units
    command: Callable[[Seen, Parameters], Floats]  # function that returns the acceleration, [n] m/s2
    # Function that returns for each world whether there is a danger, [n] bool. None: the law acts from the start.
    notices: Callable[[Seen, Parameters], Bools] | None = None
    stays: bool = False  # whether the reaction continues after the danger is over
    # Names of the parameters that may be 0; all other parameters must be above 0.
    may_be_zero: frozenset[str] = field(default=frozenset({"T", "s0", "rho", "reaction", "perception", "release"}))


_MOST = 0.774 * 9.81  # m/s2

_FREE = {"free": 2.0, "speed": 0.4, "v0": 33.3}  # speed control to v0 beyond the headway `free` (s)

LAWS: dict[str, Law] = {
    "idm": Law(
        "intelligent driver model", "Treiber, Hennecke and Helbing 2000, doi:10.1103/PhysRevE.62.1805",
        {"T": 1.5, "s0": 2.0, "a": 1.4, "b": 2.0, "v0": 33.3}, _idm,
    ),
    "acc": Law(
        "adaptive cruise control of PATH", "Milanes and Shladover 2014, doi:10.1016/j.trc.2014.09.001",
        {"T": 1.1, "s0": 0.0, "gap": 0.23, "rate": 0.07, **_FREE}, _acc,
    ),
    "cacc": Law(
        "cooperative adaptive cruise control of PATH", "the same, with the defaults of SUMO's CACC",
        {"T": 1.0, "s0": 2.5, "gap": 0.45, "rate": 0.0125, **_FREE}, _cacc,
    ),
    "rss": Law(
        "responsibility-sensitive safety", "Shalev-Shwartz, Shammah and Shashua 2017, arXiv 1708.06374",
        {"rho": 1.0, "a": 3.5, "b_min": 4.0, "b_max": 8.0}, _rss,
    ),
    "r157_human": Law(
        "competent and careful human driver of UN R157", "UN R157, annex 3, and its performance model of the JRC",
        {"perception": 0.4, "reaction": 0.75, "release": 0.4, "jerk": 12.65, "most": _MOST, "front": 5.0,
         "headway": 2.0, "ttc": 2.0}, _human, _human_notices, stays=True,
    ),
    "r157_fsm": Law(
        "fuzzy safety model of UN R157", "Mattas et al. 2022, doi:10.1016/j.aap.2022.106743",
        {"reaction": 0.75, "b_min": 4.0, "b_max": 6.0, "b_front": 7.0, "margin": 2.0, "margin_safe": 2.0,
         "jerk": 12.65, "most": _MOST}, _fsm, _fsm_notices,
    ),
    "aeb": Law(
        "automatic emergency braking: full braking where time to collision or required deceleration pass a limit",
        "our own short version", {"ttc": 1.5, "required": 5.0}, _aeb,
    ),
}  # fmt: skip


class Controller:
    """Agent that follows a ``Law``.

    The memory of the controller is the time at which it noticed a danger, [n] s: infinite if it has noticed no danger,
    and NaN before the first decision.

    The reaction time begins when the controller notices a danger. If there is a danger at the first decision, the
    reaction time begins at the alert, so it overlaps with the latency. If ``law.stays`` is true (law ``r157_human``),
    the controller keeps reacting after the danger is over. If ``law.stays`` is false (law ``r157_fsm``), the reaction
    ends with the danger, and the next danger starts a new reaction time.

    Args:
        name: name of the agent, such as ``idm:T=1.0``.
        law: the law.
        parameters: value of each parameter of the law.
        step_s: time between two decisions (s).

    """

    knows = Source.MESSAGES  # the agent decides on received messages

    def __init__(self, name: str, law: Law, parameters: Mapping[str, float], step_s: float) -> None:
        self.name, self.law, self.parameters, self.time_step_s = name, law, Parameters(**parameters), step_s

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Floats:
        """Return the memory before the first decision: an array [n] of NaN.

        Raises ``InvalidInput`` if the law needs a quantity of the vehicle ahead that neither messages nor sensors
        provide.
        """
        ahead = vehicle - 1
        if vehicle and np.isinf(Messages.of(alert).seen_from_s(vehicle, ahead)).any():
            refuse_untold(alert, [vehicle], f"agent {self.name!r}", MEASURED, [ahead])
        return np.full(alert.n, np.nan)

    def act(self, worlds: Worlds, memory: Floats, vehicle: int) -> tuple[Floats, Floats]:
        """Return the command, [n] m/s2, limited by the vehicle's capacities, and the new memory [n]."""
        seen, p, vehicles = Seen.of(worlds, vehicle, self.time_step_s), self.parameters, worlds.vehicles
        command = self.law.command(seen, p)
        if self.law.notices is not None:
            now = np.where(np.isnan(memory), 0.0, worlds.time_s)
            before = np.where(np.isnan(memory), np.inf, memory)
            gone = before if self.law.stays else np.inf
            memory = np.where(self.law.notices(seen, p), np.minimum(before, now), gone)
            elapsed, perceiving = worlds.time_s - memory + _SAME_S, getattr(p, "perception", 0.0)
            waiting = np.where(elapsed < perceiving, 0.0, np.minimum(seen.own_mps2, -getattr(p, "release", 0.0)))
            command = np.where(elapsed < perceiving + p.reaction, waiting, command)
        least, most = -vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
        return np.clip(command, least, most), memory


def make_controller(argument: str | None, settings: AgentSettings) -> Controller:
    """Return the controller with the name ``settings.spec``, such as ``idm:T=1.0``.

    ``argument`` are the values of parameters in this name, such as ``T=1.0`` or ``T=1.0:a=2``; None: default values.

    Raises ``UnknownName`` for a parameter that the law does not have. Raises ``InvalidInput`` if a value is not a
    number or is out of range, or if a parameter is repeated.
    """
    name = settings.spec.partition(":")[0]
    law, where = LAWS[name], f"agent {settings.spec!r}"
    parameters: dict[str, float] = {}
    for part in [] if argument is None else argument.split(":"):
        key, _, text = part.partition("=")
        if key not in law.parameters:
            raise unknown_name(f"{where}: parameter", key, law.parameters)
        value = parse_numeral(text)
        if value is None or not (0.0 < value < math.inf or (value == 0.0 and key in law.may_be_zero)):
            least = "of 0 or more" if key in law.may_be_zero else "above 0"
            raise InvalidInput(
                f"{where}: {key} must be a finite number {least}, for instance {key}={law.parameters[key]:g}"
            )
        if key in parameters:
            raise InvalidInput(f"{where}: parameter {key} is given twice; give it once")
        parameters[key] = value
    parameters = {**law.parameters, **parameters}
    if parameters.get("b_min", 0.0) > parameters.get("b_max", math.inf):
        raise InvalidInput(
            f"{where}: b_min = {parameters['b_min']:g}: must be at most b_max, which is {parameters['b_max']:g}"
        )
    return Controller(settings.spec, law, parameters, settings.time_step_s)


IDM = Part(make_controller, form="idm[:T=1.5]", about="the intelligent driver model", knows=Source.MESSAGES)

ACC = Part(make_controller, form="acc[:T=1.1]", about="adaptive cruise control of PATH", knows=Source.MESSAGES)

CACC = Part(
    make_controller, form="cacc[:T=1.0]", about="its cooperative one, at a shorter distance", knows=Source.MESSAGES
)

RSS = Part(make_controller, form="rss[:rho=1.0]", about="brakes within the safe distance of RSS", knows=Source.MESSAGES)

R157_HUMAN = Part(
    make_controller,
    form="r157_human[:reaction=0.75]",
    about="the careful and competent driver of UN R157",
    knows=Source.MESSAGES,
)

R157_FSM = Part(
    make_controller, form="r157_fsm[:reaction=0.75]", about="the fuzzy safety model of UN R157", knows=Source.MESSAGES
)

AEB = Part(make_controller, form="aeb[:ttc=1.5]", about="automatic emergency braking", knows=Source.MESSAGES)

FIELD = ("idm", "acc", "cacc", "rss", "r157_human", "r157_fsm", "aeb")  # the agents of ``--agents field``
