"""Noisy and false reports: the key ``reports`` of a scenario's ``v2x``.

Every vehicle sees the other vehicles' speeds with an error ``bias_mps + noise_mps z``, and their places with an error
``noise_m y``, where z and y are standard normal numbers for each world, vehicle and decision (one of each for all
messages before the first decision). The ``liar`` also seems neither to brake nor to drive, and a plan that it tells
says so. Messages contain these errors, so an old message keeps the error it was sent with. What a vehicle measures of
itself is exact, and so is the place of an obstacle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.episode.plans import PlanMemory
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.links import PLACE_ERRORS_KEY
from ethbrake_marl.files.model import require
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.elementary import hash_number, normal_quantile_each
from ethbrake_marl.motion.layout import FAR_M, FORCE, GAP, SPEED, Bools, Floats
from ethbrake_marl.worlds.channel import V2X, ChannelKey
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantities import OF_WORLD
from ethbrake_marl.worlds.quantity import ScenarioPart
from ethbrake_marl.worlds.roles import check_vehicle
from ethbrake_marl.worlds.scenario import Scenario

NAME = "reports"  # of the key, and of the memory: a whole number below 2^53 for each world, [n]
NOISE = (6,)  # stream of these numbers
MOST = 50.0  # largest noise (m/s, m) and bias (m/s)
COASTING = 0.0  # each number of a plan of coasting


@large
def chances(keys, steps, out):
    """Write random numbers in [0, 1) for each world to ``out`` [n, numbers].

    They are hashes of the world's key in ``keys`` [n], the column, and the number of the decision in ``steps`` [n].
    """
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[k, i] = hash_number(keys[k], i, steps[k])


@dataclass(frozen=True)
class ReportsLayer(Layer):
    """Lets a vehicle see the others' speeds and places with errors, and the liar as if it neither braked nor drove.

    Gaps that body 0 sees are exact: the errors of places are in its memory ``place_errors``.
    """

    noise_mps: float = 0.0  # standard deviation
    noise_m: float = 0.0
    bias_mps: float = 0.0
    liar: int = 0  # body of the vehicle that seems not to brake; 0: none

    def seen(self, state: State, body: int) -> State:
        line, wanted, memories, N = state.line.copy(), state.wanted.copy(), dict(state.memories), state.vehicles
        numbers, is_own = np.empty((state.n, 2 * N)), np.arange(1, N + 1) == body
        chances(state.memories[NAME], state.steps, numbers)
        numbers = normal_quantile_each(numbers)
        line[:, SPEED, 1:] += np.where(is_own, 0.0, self.bias_mps + self.noise_mps * numbers[:, :N])
        place = np.zeros((state.n, N + 1))
        place[:, 1:] = np.where(is_own, 0.0, self.noise_m * numbers[:, N:])
        if self.noise_m > 0.0 and body == 0:
            memories[PLACE_ERRORS_KEY] = place
        elif self.noise_m > 0.0:
            gap = line[:, GAP, :-1]
            line[:, GAP, :-1] = np.where(gap < FAR_M, np.maximum(gap + place[:, :-1] - place[:, 1:], 0.0), gap)
        if self.liar not in (0, body):
            line[:, FORCE, self.liar] = wanted[:, self.liar] = 0.0
            if isinstance(memory := memories.get(self.liar), PlanMemory):
                memories[self.liar] = memory._replace(plan=np.where(np.isnan(memory.plan), np.nan, COASTING))
        return state._replace(line=line, wanted=wanted, memories=memories)

    def hides(self, alert: State, body: int) -> Bools:
        bodies = np.arange(alert.vehicles + 1)
        return np.tile((bodies != 0) & (bodies != body), (alert.n, 1))


class ReportErrors(ScenarioPart):
    """Content of the key ``reports``."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1})

    noise_mps: float = Field(
        default=0.0, ge=0.0, le=MOST,
        description="standard deviation of the normal error of reported speeds, drawn anew at every decision",
    )  # fmt: skip
    noise_m: float = Field(
        default=0.0, ge=0.0, le=MOST,
        description="standard deviation of the normal error of reported places, drawn anew at every decision",
    )  # fmt: skip
    bias_mps: float = Field(default=0.0, ge=-MOST, le=MOST, description="constant error of reported speeds")
    liar: str = Field(
        default="vehicle_0",
        description="vehicle that reports no acceleration, no intent and a plan of coasting, whatever it does",
    )

    @model_validator(mode="after")
    def _has_effect(self) -> Self:
        zeros = [key for key in self.model_fields_set if getattr(self, key) == 0.0]
        require(not zeros, tuple(zeros[:1]), 0.0, "has no effect; leave it out")
        require(len(self.model_fields_set) > 0, (), {}, "must set noise_mps, noise_m, bias_mps or liar")
        return self


class ReportKeys(ScenarioPart):
    reports: ReportErrors | None = Field(
        default=None, description="errors of what vehicles report and measure of each other"
    )


class Reports(ChannelKey):
    """Errors in what vehicles report and measure of each other (key ``reports`` of ``v2x``).

    The errors are noise of speeds and places, bias of speeds, and a vehicle that lies about acceleration and intent.
    """

    name, keys = NAME, ReportKeys

    def is_random(self, v2x: V2X) -> bool:
        errors = _errors(v2x)
        return errors.noise_mps > 0.0 or errors.noise_m > 0.0

    def check(self, scenario: Scenario) -> None:
        """Raise ``InvalidInput`` if the key ``liar`` names no vehicle of the scenario."""
        errors = _errors(scenario.v2x)
        if "liar" in errors.model_fields_set:
            check_vehicle(errors.liar, scenario.vehicles, ("v2x", NAME, "liar"), errors.liar)

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> Floats:
        return numbers(OF_WORLD, NOISE)[:, 0] * 2.0**53

    def layer(self, v2x: V2X) -> ReportsLayer:
        errors = _errors(v2x)
        return ReportsLayer(
            errors.noise_mps, errors.noise_m, errors.bias_mps, int(errors.liar.removeprefix("vehicle_"))
        )


def _errors(v2x: V2X) -> ReportErrors:
    return ReportErrors.model_validate((v2x.model_extra or {})[NAME])


REPORTS = Reports()
