"""Noisy and false reports: the key ``reports`` of a scenario's ``v2x``.

Every vehicle sees the other vehicles' speeds with an error ``bias_mps + noise_mps z``, where z is a standard normal
number for each world, vehicle and decision. The ``liar`` also seems neither to brake nor to drive. Messages contain
these errors, so an old message keeps the error it was sent with. Gaps, and what a vehicle measures of itself, are
exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.links import loss_number
from ethbrake_marl.files.model import UNSHOWN, require, suggestion
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.elementary import normal_quantile_each
from ethbrake_marl.motion.layout import FORCE, SPEED, Bools, Floats
from ethbrake_marl.worlds.channel import V2X, Extension
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantities import OF_WORLD
from ethbrake_marl.worlds.roles import check_vehicle
from ethbrake_marl.worlds.scenario import Scenario

NAME = "reports"  # of the key, and of the memory: a whole number below 2^53 for each world, [n]
NOISE = (6,)  # stream of these numbers
REPORT_KEYS = ("noise_mps", "bias_mps", "liar")
MOST_MPS = 50.0  # largest noise and bias


@large
def chances(keys, steps, out):
    """Write a random number in [0, 1) for each world and vehicle to ``out`` [n, N].

    It is a hash of the world's key in ``keys`` [n], the vehicle, and the number of the decision in ``steps`` [n].
    """
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[k, i] = loss_number(keys[k], i, steps[k])


@dataclass(frozen=True)
class ReportsLayer(Layer):
    """Lets a vehicle see the others' speeds with errors, and the liar as if it neither braked nor drove."""

    noise_mps: float = 0.0  # standard deviation
    bias_mps: float = 0.0
    liar: int = 0  # body of the vehicle that seems not to brake; 0: none

    def seen(self, state: State, body: int) -> State:
        line, wanted, error = state.line.copy(), state.wanted.copy(), np.empty((state.n, state.vehicles))
        chances(state.memories[NAME], state.steps, error)
        error = self.bias_mps + self.noise_mps * normal_quantile_each(error)
        line[:, SPEED, 1:] += np.where(np.arange(1, state.vehicles + 1) == body, 0.0, error)
        if self.liar not in (0, body):
            line[:, FORCE, self.liar] = wanted[:, self.liar] = 0.0
        return state._replace(line=line, wanted=wanted)

    def hides(self, alert: State, body: int) -> Bools:
        bodies = np.arange(alert.vehicles + 1)
        return np.tile((bodies != 0) & (bodies != body), (alert.n, 1))


class Reports(Extension):
    """Errors in what vehicles report and measure of each other (key ``reports`` of ``v2x``).

    The errors are noise and bias of speeds, and one vehicle that lies about its acceleration and intent.
    """

    name = NAME
    schemas: Mapping[str, dict[str, Any]] = {
        NAME: {
            "description": "errors of what vehicles report and measure of each other",
            "type": "object",
            "additionalProperties": False,
            "minProperties": 1,
            "properties": {
                "noise_mps": {
                    "description": "standard deviation of the normal error of reported speeds, drawn anew at every"
                    " decision",
                    "type": "number",
                    "minimum": 0,
                    "maximum": MOST_MPS,
                },
                "bias_mps": {
                    "description": "constant error of reported speeds",
                    "type": "number",
                    "minimum": -MOST_MPS,
                    "maximum": MOST_MPS,
                },
                "liar": {
                    "description": "vehicle that reports no acceleration and no intent, whatever it does",
                    "type": "string",
                },
            },
        }
    }

    def read(self, key: str, value: Any) -> Any:
        """Value of the key ``reports`` as plain data. Raises an error for unknown keys and for numbers out of range."""
        right = "must be a mapping, such as {noise_mps: 0.5, bias_mps: 1, liar: vehicle_1}"
        require(isinstance(value, Mapping) and len(value) > 0, (key,), value, right)
        for name, content in value.items():
            at = (key, name)
            require(
                name in REPORT_KEYS,
                at,
                UNSHOWN,
                f"unknown key; {suggestion(str(name), REPORT_KEYS) or f'known: {REPORT_KEYS}'}",
            )
            if name == "liar":
                require(isinstance(content, str), at, content, "must be the name of a vehicle, such as vehicle_1")
                continue
            low = 0.0 if name == "noise_mps" else -MOST_MPS
            number = isinstance(content, int | float) and not isinstance(content, bool) and low <= content <= MOST_MPS
            require(number and content != 0.0, at, content, f"must be from {low:g} to {MOST_MPS:g} m/s, and not 0")
        return dict(value)

    def is_random(self, v2x: V2X) -> bool:
        return "noise_mps" in _value(v2x)

    def check(self, scenario: Scenario) -> None:
        """Raise an error if the ``liar`` is no vehicle of the scenario."""
        liar = _value(scenario.v2x).get("liar")
        if liar is not None:
            check_vehicle(liar, scenario.vehicles, ("v2x", NAME, "liar"), liar)

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> Floats:
        return numbers(OF_WORLD, NOISE)[:, 0] * 2.0**53

    def layer(self, v2x: V2X) -> ReportsLayer:
        value = _value(v2x)
        liar = int(value.get("liar", "vehicle_0").removeprefix("vehicle_"))
        return ReportsLayer(value.get("noise_mps", 0.0), value.get("bias_mps", 0.0), liar)


def _value(v2x: V2X) -> Mapping[str, Any]:
    value: Mapping[str, Any] = (v2x.model_extra or {})[NAME]
    return value


REPORTS = Reports()
