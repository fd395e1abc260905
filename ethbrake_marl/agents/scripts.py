"""Scripts: full braking, coasting, a constant, and two baselines that know only the vehicle in front."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import optimise_pairwise
from ethbrake_marl.agents.protocol import Agent, Source
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.engine import Script
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.scenario import ScriptSpec


class StateFree:
    """``full_brake``, ``coast`` or ``constant:a`` (deceleration in m/s2): the same command whatever happens.

    ``full_brake`` of every vehicle is the paper's non-ethical strategy. Raises ``InvalidInput`` for any other script
    and for a constant beyond the vehicle's capacity.
    """

    state_free = True
    knows = Source.SENSORS

    def __init__(self, spec: str) -> None:
        if not ScriptSpec.parse(spec).is_state_free():
            raise InvalidInput(f"agent {spec!r}: must be full_brake, coast or constant:a")
        self.name = spec

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The constant command, [n] m/s2."""
        vehicles = worlds.vehicles
        command = ScriptSpec.parse(self.name).command(
            vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
        )
        assert command is not None
        return command


class CopyLeader:
    """Brake exactly as hard as the vehicle in front can, as far as the own brakes allow.

    ``a = min(a_front, a_own)``. Needs one number from the front vehicle. Raises ``InvalidInput`` for the first vehicle.
    """

    name = "copy_leader"
    state_free = True
    knows = Source.STATE

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """``-min(a_front, a_own)``, [n] m/s2."""
        _check_has_front(self.name, vehicle)
        capacity = worlds.vehicles.braking_capacity_mps2
        return -np.minimum(capacity[:, vehicle - 1], capacity[:, vehicle])


class GentlestFront:
    """The smallest constant deceleration that spares the vehicle in front; full braking if none does.

    From the pairwise closed form; it needs nothing from the vehicle behind, and collides in the very worlds in which
    E-V2X-BM does: what it lacks is the choice between two harms. Raises ``InvalidInput`` for the first vehicle.
    """

    name = "gentlest_front"
    state_free = True  # once the episode has begun
    knows = Source.STATE

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Floats:
        """The command of these episodes."""
        _check_has_front(self.name, vehicle)
        least = optimise_pairwise(alert, vehicle).spares_front_mps2
        return -np.minimum(least, alert.vehicles.braking_capacity_mps2[:, vehicle])

    def act(self, worlds: Worlds, memory: Floats, vehicle: int) -> tuple[Floats, Floats]:
        """That command, [n] m/s2."""
        return memory, memory


def make_state_free(argument: str | None, settings: AgentSettings) -> Agent:
    """``full_brake``, ``coast`` or ``constant:A``, as it is written."""
    return StateFree(settings.spec)


def make_copy_leader(argument: None, settings: AgentSettings) -> Agent:
    """``copy_leader``."""
    return CopyLeader()


def make_gentlest_front(argument: None, settings: AgentSettings) -> Agent:
    """``gentlest_front``."""
    return GentlestFront()


def _check_has_front(name: str, vehicle: int) -> None:
    if vehicle < 1:
        raise InvalidInput(f"agent {name!r}: vehicle_{vehicle + 1} has no vehicle in front of it")
