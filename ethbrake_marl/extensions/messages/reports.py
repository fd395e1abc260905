"""Noisy and false reports: the key ``reports`` of a scenario's ``v2x``.

Every vehicle sees the other vehicles' speeds with an error ``bias_mps + noise_mps z``, where z is a standard normal
number for each world, vehicle and decision (one z for all messages before the first decision). The ``liar`` also seems
neither to brake nor to drive, and a plan that it tells says so. Messages contain these errors, so an old message keeps
the error it was sent with. Gaps, and what a vehicle measures of itself, are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.episode.plans import PlanMemory
from ethbrake_marl.episode.state import State
from ethbrake_marl.files.model import require
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.elementary import hash_number, normal_quantile_each
from ethbrake_marl.motion.layout import FORCE, SPEED, Bools, Floats
from ethbrake_marl.worlds.channel import V2X, ChannelKey
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantities import OF_WORLD
from ethbrake_marl.worlds.quantity import ScenarioPart
from ethbrake_marl.worlds.roles import check_vehicle
from ethbrake_marl.worlds.scenario import Scenario

NAME = "reports"  # of the key, and of the memory: a whole number below 2^53 for each world, [n]
NOISE = (6,)  # stream of these numbers
MOST_MPS = 50.0  # largest noise and bias
COASTING = 0.0  # each number of a plan of coasting


@large
def chances(keys, steps, out):
    """Write a random number in [0, 1) for each world and vehicle to ``out`` [n, N].

    It is a hash of the world's key in ``keys`` [n], the vehicle, and the number of the decision in ``steps`` [n].
    """
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[k, i] = hash_number(keys[k], i, steps[k])


@dataclass(frozen=True)
class ReportsLayer(Layer):
    """Lets a vehicle see the others' speeds with errors, and the liar as if it neither braked nor drove."""

    noise_mps: float = 0.0  # standard deviation
    bias_mps: float = 0.0
    liar: int = 0  # body of the vehicle that seems not to brake; 0: none

    def seen(self, state: State, body: int) -> State:
        line, wanted, error = state.line.copy(), state.wanted.copy(), np.empty((state.n, state.vehicles))
        memories = dict(state.memories)
        chances(state.memories[NAME], state.steps, error)
        error = self.bias_mps + self.noise_mps * normal_quantile_each(error)
        line[:, SPEED, 1:] += np.where(np.arange(1, state.vehicles + 1) == body, 0.0, error)
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
        default=0.0, ge=0.0, le=MOST_MPS,
        description="standard deviation of the normal error of reported speeds, drawn anew at every decision",
    )  # fmt: skip
    bias_mps: float = Field(default=0.0, ge=-MOST_MPS, le=MOST_MPS, description="constant error of reported speeds")
    liar: str = Field(
        default="vehicle_0",
        description="vehicle that reports no acceleration, no intent and a plan of coasting, whatever it does",
    )

    @model_validator(mode="after")
    def _has_effect(self) -> Self:
        zeros = [key for key in self.model_fields_set if getattr(self, key) == 0.0]
        require(not zeros, tuple(zeros[:1]), 0.0, "has no effect; leave it out")
        require(len(self.model_fields_set) > 0, (), {}, "must set noise_mps, bias_mps or liar")
        return self


class ReportKeys(ScenarioPart):
    reports: ReportErrors | None = Field(
        default=None, description="errors of what vehicles report and measure of each other"
    )


class Reports(ChannelKey):
    """Errors in what vehicles report and measure of each other (key ``reports`` of ``v2x``).

    The errors are noise and bias of speeds, and one vehicle that lies about its acceleration and intent.
    """

    name, keys = NAME, ReportKeys

    def is_random(self, v2x: V2X) -> bool:
        return _errors(v2x).noise_mps > 0.0

    def check(self, scenario: Scenario) -> None:
        """Raise ``InvalidInput`` if the key ``liar`` names no vehicle of the scenario."""
        errors = _errors(scenario.v2x)
        if "liar" in errors.model_fields_set:
            check_vehicle(errors.liar, scenario.vehicles, ("v2x", NAME, "liar"), errors.liar)

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> Floats:
        return numbers(OF_WORLD, NOISE)[:, 0] * 2.0**53

    def layer(self, v2x: V2X) -> ReportsLayer:
        errors = _errors(v2x)
        return ReportsLayer(errors.noise_mps, errors.bias_mps, int(errors.liar.removeprefix("vehicle_")))


def _errors(v2x: V2X) -> ReportErrors:
    return ReportErrors.model_validate((v2x.model_extra or {})[NAME])


REPORTS = Reports()
