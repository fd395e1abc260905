"""Scripts that hold one command: full braking (the paper's non-ethical strategy), coasting, a constant deceleration."""

from __future__ import annotations

from typing import Any, NamedTuple

from ethbrake_marl.episode.layer import SENSORS
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.roles import check_role, first_command


class Held(NamedTuple):
    """Holds the command of a role: ``full_brake``, ``coast`` or ``constant:a`` (deceleration a in m/s2)."""

    name: str
    knows: str = SENSORS

    def begin(self, alert: State, body: int) -> Floats:
        return first_command(self.name, alert.braking_capacity_mps2[:, body - 1])

    def act(self, state: State, memory: Floats, body: int) -> tuple[Floats, Floats]:
        return memory, memory


FULL_BRAKE, COAST = Held("full_brake"), Held("coast")


def make_held(argument: str | None, settings: Any) -> Held:
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
