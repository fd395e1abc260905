"""Scripts that hold one command: full braking (the paper's non-ethical strategy), coasting, a constant deceleration."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import SENSORS
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.roles import check_role, first_command


class Held(NamedTuple):
    """Holds the command of a role: ``full_brake``, ``coast`` or ``constant:a`` (deceleration a in m/s2)."""

    name: str
    knows: str = SENSORS

    def begin(self, alert: State, body: int) -> Floats:
        """Return the command, [n] m/s2. Raises ``InvalidInput`` if it is beyond a capacity of the vehicle."""
        braking, driving = alert.car[:, BRAKING, body], alert.car[:, DRIVING, body]
        command = first_command(self.name, braking)
        beyond = np.flatnonzero((command < -braking) | (command > driving))
        if len(beyond):
            k, numbers = beyond[0], alert.clock[:, NUMBER].astype(int)
            raise InvalidInput(
                f"agent {self.name!r}: vehicle_{body} can decelerate by at most {braking[k]:g} m/s2 and accelerate by"
                f" at most {driving[k]:g} m/s2 in world {numbers[k] if numbers[k] >= 0 else k}"
            )
        return command

    def act(self, state: State, memory: Floats, body: int) -> tuple[Floats, Floats]:
        """Return the command, which is the memory."""
        return memory, memory


FULL_BRAKE, COAST = Held("full_brake"), Held("coast")


def make_held(argument: str | None, settings: Any) -> Held:
    """Return the script with the name ``settings.spec``. Raises ``InvalidInput`` unless its argument is right."""
    check_role(settings.spec)
    return Held(settings.spec)


FULL_BRAKE_ENTRY = Part(
    make_held, form="full_brake", about="full braking, the paper's non-ethical strategy", knows=SENSORS
)
COAST_ENTRY = Part(make_held, form="coast", about="neither brake nor drive", knows=SENSORS)
CONSTANT_ENTRY = Part(
    make_held, form="constant:A", about="constant deceleration A in m/s2; a negative A drives", knows=SENSORS
)

LADDER = ("coast", "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm")  # agents that need no training, from bad to good
