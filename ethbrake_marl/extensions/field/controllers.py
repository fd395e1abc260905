"""Controllers from the literature: car-following models, the driver models of UN R157, emergency braking.

A *law* is the formula of a controller: it computes a command from the motion of the vehicle itself and of the vehicle
ahead. ``LAWS`` lists all laws with their parameters and sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MESSAGES, check_seen
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.motion.layout import FAR_M, FORCE, GAP, SPEED, Bools, Floats
from ethbrake_marl.registry import Part

LEAST_GAP_M = 1e-6  # least gap for a law, because laws divide by the gap
SAME_S = 1e-9  # tolerance for rounding of an elapsed time (s)


class Parameters:
    """Parameters of one law, in SI units."""

    def __init__(self, **values: float) -> None:
        self.__dict__.update(values)

    def __getattr__(self, name: str) -> float:
        raise AttributeError(name)


class KnownMotion(NamedTuple):
    """What one vehicle knows in n worlds of itself and of what is ahead. The gap to nothing, or to the unknown, is
    infinite.
    """

    gap_m: Floats  # [n] gap to the vehicle or obstacle ahead
    speed_mps: Floats  # [n] own speed
    front_mps: Floats  # [n] speed of the vehicle or obstacle ahead
    front_mps2: Floats  # [n] acceleration in force of the vehicle ahead
    own_mps2: Floats  # [n] own acceleration in force
    step_s: float  # time until the next decision (s)

    @classmethod
    def of(cls, state: State, body: int, step_s: float) -> KnownMotion:
        """What ``body`` knows in the worlds that it estimates. ``step_s``: time until the next decision (s)."""
        line, ahead = state.line, body - 1
        is_known = state.know[:, body, ahead] <= state.time_s if ahead else line[:, GAP, 0] < FAR_M
        front, force = np.where(is_known, line[:, [SPEED, FORCE], ahead].T, 0.0)
        gap = np.where(is_known, np.maximum(line[:, GAP, ahead], LEAST_GAP_M), np.inf)
        return cls(gap, line[:, SPEED, body], front, force, line[:, FORCE, body], step_s)

    @property
    def closing_mps(self) -> Floats:
        """Speed at which the gap ahead closes, [n] m/s; negative if the gap opens."""
        return self.speed_mps - self.front_mps

    @property
    def until_contact_s(self) -> Floats:
        """Time until contact at present speeds, [n] s; infinite if the gap does not close."""
        closing = self.closing_mps
        return np.where(closing > 0.0, self.gap_m / np.where(closing > 0.0, closing, 1.0), np.inf)

    @property
    def headway_s(self) -> Floats:
        """Gap ahead divided by the own speed, [n] s; infinite if this speed is not above 0."""
        return np.where(self.speed_mps > 0.0, self.gap_m / np.where(self.speed_mps > 0.0, self.speed_mps, 1.0), np.inf)

    def built_up(self, wanted_mps2: Floats, rate_mps3: float) -> Floats:
        """``wanted_mps2``, but with a deceleration that grows by at most ``rate_mps3``, [n] m/s2."""
        return np.maximum(wanted_mps2, np.minimum(self.own_mps2, 0.0) - rate_mps3 * self.step_s)


def _idm(motion: KnownMotion, p: Parameters) -> Floats:
    desired_gap_m = p.s0 + np.maximum(
        0.0, motion.speed_mps * p.T + motion.speed_mps * motion.closing_mps / (2 * math.sqrt(p.a * p.b))
    )
    return p.a * (1.0 - np.square(np.square(motion.speed_mps / p.v0)) - np.square(desired_gap_m / motion.gap_m))


def _is_free(motion: KnownMotion, p: Parameters) -> Bools:
    return motion.gap_m > p.free * np.maximum(motion.speed_mps, 1.0) + p.s0


def _acc(motion: KnownMotion, p: Parameters) -> Floats:
    gap = p.gap * (motion.gap_m - p.s0 - p.T * motion.speed_mps) - p.rate * motion.closing_mps
    return np.where(_is_free(motion, p), p.speed * (p.v0 - motion.speed_mps), gap)


def _cacc(motion: KnownMotion, p: Parameters) -> Floats:
    wide = motion.gap_m - p.s0 - p.T * motion.speed_mps
    rate = -motion.closing_mps - p.T * motion.own_mps2
    keeps, closes = p.gap * wide + p.rate * rate, 0.005 * wide + 0.05 * rate
    change = np.where(wide < 0.0, p.gap * wide + 0.05 * rate, np.where(wide < 0.2, keeps, closes))
    return np.where(_is_free(motion, p), p.speed * (p.v0 - motion.speed_mps), change / motion.step_s)


def _safe_distance(motion: KnownMotion, p: Parameters) -> Floats:
    speed = np.maximum(motion.speed_mps, 0.0)
    ahead = np.square(np.maximum(motion.front_mps, 0.0)) / (2.0 * p.b_max)
    way = speed * p.rho + 0.5 * p.a * p.rho * p.rho + np.square(speed + p.rho * p.a) / (2.0 * p.b_min)
    return np.maximum(way - ahead, 0.0)


def _rss(motion: KnownMotion, p: Parameters) -> Floats:
    return np.where(motion.gap_m < _safe_distance(motion, p), -p.b_min, 0.0)


def _human(motion: KnownMotion, p: Parameters) -> Floats:
    return motion.built_up(np.full_like(motion.gap_m, -p.most), p.jerk)


def _human_notices(motion: KnownMotion, p: Parameters, noticed: Bools) -> Bools:
    brakes = (motion.front_mps2 < -p.front) & (motion.headway_s < p.headway)
    is_near = motion.gap_m <= p.margin + p.headway * motion.speed_mps
    return brakes | (motion.until_contact_s < p.ttc) | (noticed & is_near)


def _share(distance: Floats, safe: Floats, unsafe: Floats) -> Floats:
    """Danger [n]: 0 where ``distance`` is above ``safe``, 1 where it is below ``unsafe``, and linear in between."""
    between = (safe - distance) / np.where(safe > unsafe, safe - unsafe, 1.0)
    return np.where(distance > safe, 0.0, np.where(distance < unsafe, 1.0, between))


def fuzzy_criteria(motion: KnownMotion, p: Parameters) -> tuple[Floats, Floats]:
    """Proactive and critical criterion of the fuzzy safety model of UN R157, [n] each: danger from 0 to 1.

    ``p``: parameters of the law ``r157_fsm``.
    """
    speed, front = np.maximum(motion.speed_mps, 0.0), np.maximum(motion.front_mps, 0.0)
    ahead, reacting = np.square(front) / (2.0 * p.b_front), speed * p.reaction
    proactive = _share(
        motion.gap_m - p.margin,
        reacting + np.square(speed) / (2.0 * p.b_min) - ahead + p.margin_safe,
        reacting + np.square(speed) / (2.0 * p.b_max) - ahead,
    )
    ego_mps2 = np.maximum(motion.own_mps2, -p.b_min)
    after = speed + p.reaction * ego_mps2 - front
    way = (speed + 0.5 * ego_mps2 * p.reaction - front) * p.reaction
    critical = _share(motion.gap_m, way + np.square(after) / (2.0 * p.b_min), way + np.square(after) / (2.0 * p.b_max))
    slows = (after < 0.0) & (ego_mps2 < 0.0)  # slower than the vehicle ahead after the reaction time
    until = np.square(speed - front) / (2.0 * np.where(slows, -motion.own_mps2, 1.0))
    critical = np.where(slows, np.where(motion.gap_m < until, 1.0, 0.0), critical)
    return proactive, np.where(speed > front, critical, 0.0)


def _fsm_notices(motion: KnownMotion, p: Parameters, noticed: Bools) -> Bools:
    proactive, critical = fuzzy_criteria(motion, p)
    return (proactive + critical > 0.0) & (noticed | (motion.closing_mps > 0.0))


def _fsm(motion: KnownMotion, p: Parameters) -> Floats:
    proactive, critical = fuzzy_criteria(motion, p)
    deceleration = np.where(critical > 0.0, critical * (p.b_max - p.b_min) + p.b_min, proactive * p.b_min)
    return motion.built_up(-np.minimum(deceleration, p.most), p.jerk)


def _aeb(motion: KnownMotion, p: Parameters) -> Floats:
    return np.full_like(motion.gap_m, -np.inf)


def _aeb_notices(motion: KnownMotion, p: Parameters, noticed: Bools) -> Bools:
    required = np.square(np.maximum(motion.closing_mps, 0.0)) / (2.0 * motion.gap_m)
    begins = (motion.until_contact_s < p.ttc) | (required > p.required)
    return begins | (noticed & (motion.until_contact_s <= p.release_ttc))


@dataclass(frozen=True, slots=True)
class Law:
    """A controller from the literature: its formula, with the default parameters and the source."""

    about: str  # name of the controller
    source: str  # publication of the formula
    parameters: Mapping[str, float]  # default value of each parameter, in SI units
    command: Callable[[KnownMotion, Parameters], Floats]  # function that returns the acceleration, [n] m/s2
    # Function that returns for each world whether there is a danger, [n] bool; its last argument says where there was
    # one at the last decision. None: the law acts from the start.
    notices: Callable[[KnownMotion, Parameters, Bools], Bools] | None = None


MAY_BE_ZERO = (
    "T",
    "s0",
    "rho",
    "reaction",
    "perception",
    "release",
    "sd",
    "margin",
)  # parameters; all others must be above 0
LARGEST_BRAKING_MPS2 = 0.774 * 9.81  # m/s2

FREE = {"free": 2.0, "speed": 0.4, "v0": 33.3}  # speed control to v0 beyond the headway `free` (s)

LAWS: dict[str, Law] = {
    "idm": Law(
        "intelligent driver model", "Treiber, Hennecke and Helbing 2000, doi:10.1103/PhysRevE.62.1805",
        {"T": 1.5, "s0": 2.0, "a": 1.4, "b": 2.0, "v0": 33.3}, _idm,
    ),
    "acc": Law(
        "adaptive cruise control of PATH", "Milanes and Shladover 2014, doi:10.1016/j.trc.2014.09.001",
        {"T": 1.1, "s0": 0.0, "gap": 0.23, "rate": 0.07, **FREE}, _acc,
    ),
    "cacc": Law(
        "cooperative adaptive cruise control of PATH", "the same, with the defaults of SUMO's CACC",
        {"T": 1.0, "s0": 2.5, "gap": 0.45, "rate": 0.0125, **FREE}, _cacc,
    ),
    "rss": Law(
        "responsibility-sensitive safety", "Shalev-Shwartz, Shammah and Shashua 2017, arXiv 1708.06374",
        {"rho": 1.0, "a": 3.5, "b_min": 4.0, "b_max": 8.0}, _rss,
    ),
    "r157_human": Law(
        "competent and careful human driver of UN R157",
        "UN R157, table 1 of its performance model; programs of the JRC (release, ttc) and of esmini (others)",
        {"perception": 0.4, "reaction": 0.75, "release": 0.4, "jerk": 12.65, "most": LARGEST_BRAKING_MPS2, "front": 5.0,
         "headway": 2.0, "ttc": 2.0, "margin": 2.0}, _human, _human_notices,
    ),
    "r157_fsm": Law(
        "fuzzy safety model of UN R157", "Mattas et al. 2022, doi:10.1016/j.aap.2022.106743",
        {"reaction": 0.75, "b_min": 4.0, "b_max": 6.0, "b_front": 7.0, "margin": 2.0, "margin_safe": 2.0,
         "jerk": 12.65, "most": LARGEST_BRAKING_MPS2}, _fsm, _fsm_notices,
    ),
    "aeb": Law(
        "automatic emergency braking: full braking from a time to collision until rest",
        "the AEB of esmini's UN R157; the options required and release_ttc are ours",
        {"ttc": 1.5, "required": math.inf, "release_ttc": math.inf}, _aeb, _aeb_notices,
    ),
}  # fmt: skip


def within_capacities(commands_mps2: Floats, state: State, body: int) -> Floats:
    braking, driving = state.braking_capacity_mps2, state.driving_capacity_mps2
    return np.clip(commands_mps2, -braking[:, body - 1], driving[:, body - 1])


class Controller:
    """Agent that reacts to what is ahead, with decisions every ``step_s``."""

    knows = MESSAGES
    needs_ahead = ("place", "speed", "acceleration")  # pieces of messages without which it does not drive

    def __init__(self, name: str, parameters: Mapping[str, float], step_s: float) -> None:
        self.name, self.parameters, self.step_s = name, Parameters(**parameters), step_s

    def check(self, game: Game, body: int) -> None:
        """Raise ``InvalidInput`` for a game of another time step than the controller's."""
        step_s = game.settings.time_step_s
        if not math.isclose(step_s, self.step_s):
            raise InvalidInput(
                f"agent {self.name!r} was made for decisions every {self.step_s:g} s, but scenario {game.name!r} has"
                f" one every {step_s:g} s; make it with make_agent({self.name!r}, scenario={game.name!r})"
            )


class LawController(Controller):
    """Agent that follows a ``Law``.

    Memory: time at which the present danger began, [n] s: infinite without a danger, NaN before the first decision.
    Then the reaction time begins; at the first decision, both begin at the alert. A danger ends when the law no longer
    notices it.
    """

    def __init__(self, name: str, law: Law, parameters: Mapping[str, float], step_s: float) -> None:
        super().__init__(name, parameters, step_s)
        self.law = law

    def begin(self, alert: State, body: int) -> Floats:
        return np.full(alert.n, np.nan)

    def act(self, state: State, memory: Floats, body: int) -> tuple[Floats, Floats]:
        """Commands of the vehicle ``body``, [n] m/s2, and the new memory.

        If the law notices dangers, the vehicle coasts while there is none. Between perception and the end of the
        reaction time it decelerates by at least ``release`` (m/s2).
        """
        check_seen(self, state, body)
        motion, p = KnownMotion.of(state, body, self.step_s), self.parameters
        command = self.law.command(motion, p)
        if self.law.notices is not None:
            now = np.where(np.isnan(memory), 0.0, state.time_s)
            before = np.where(np.isnan(memory), np.inf, memory)
            is_noticed = self.law.notices(motion, p, before < np.inf)
            memory = np.where(is_noticed, np.minimum(before, now), np.inf)
            elapsed, perceiving = state.time_s - memory + SAME_S, getattr(p, "perception", 0.0)
            waiting = np.where(elapsed < perceiving, 0.0, np.minimum(motion.own_mps2, -getattr(p, "release", 0.0)))
            command = np.where(elapsed < perceiving + getattr(p, "reaction", 0.0), waiting, command)
        return within_capacities(command, state, body), memory


def read_parameters(argument: str | None, where: str, defaults: Mapping[str, float]) -> dict[str, float]:
    """``defaults``, with the values of an ``argument`` such as ``T=1.0:a=2``. Raises ``UnknownName`` for an unknown
    parameter, ``InvalidInput`` for a bad value.
    """
    parameters: dict[str, float] = {}
    for part in [] if argument is None else argument.split(":"):
        key, _, text = part.partition("=")
        if key not in defaults:
            raise unknown_name(f"{where}: parameter", key, defaults)
        value, zero = parse_numeral(text), key in MAY_BE_ZERO
        if value is None or not (0.0 < value < math.inf or (value == 0.0 and zero)):
            raise InvalidInput(
                f"{where}: {key} must be a finite number {'of 0 or more' if zero else 'above 0'}, for instance"
                f" {key}={defaults[key] if math.isfinite(defaults[key]) else 2:g}"
            )
        if key in parameters:
            raise InvalidInput(f"{where}: parameter {key} is given twice; give it once")
        parameters[key] = value
    return {**defaults, **parameters}


def step_of(settings: Any) -> float:
    """Time between two decisions for which ``make_agent`` makes an agent (s)."""
    return 0.1 if settings.scenario is None else float(settings.scenario.time_step_s)


def make_controller(argument: str | None, settings: Any) -> LawController:
    """Controller such as ``idm:T=1.0``."""
    law, where = LAWS[settings.spec.partition(":")[0]], f"agent {settings.spec!r}"
    parameters = read_parameters(argument, where, law.parameters)
    if parameters.get("b_min", 0.0) > parameters.get("b_max", math.inf):
        raise InvalidInput(
            f"{where}: b_min = {parameters['b_min']:g}: must be at most b_max, which is {parameters['b_max']:g}"
        )
    return LawController(settings.spec, law, parameters, step_of(settings))


def _entry(form: str, about: str) -> Part:
    return Part(make_controller, form=form, about=about, knows=MESSAGES)


IDM = _entry("idm[:T=1.5]", "the intelligent driver model")
ACC = _entry("acc[:T=1.1]", "adaptive cruise control of the PATH programme")
CACC = _entry("cacc[:T=1.0]", "the cooperative one of the PATH programme, at a shorter distance")
RSS = _entry("rss[:rho=1.0]", "brakes within the safe distance of RSS")
R157_HUMAN = _entry("r157_human[:reaction=0.75]", "the careful and competent driver of UN R157")
R157_FSM = _entry("r157_fsm[:reaction=0.75]", "the fuzzy safety model of UN R157")
AEB = _entry("aeb[:ttc=1.5]", "automatic emergency braking")
FIELD = [*LAWS, "human"]  # the agents of ``--agents field``
