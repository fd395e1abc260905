"""Scripts (full braking, coasting, a constant command, a profile), and the registry entries of scripts and E-V2X-BM."""

from __future__ import annotations

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import make_e_v2x_bm
from ethbrake_marl.first_edition.agents.protocol import Agent, Source
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.registry import Part


class StateFree:
    """Agent with a fixed command: ``full_brake``, ``coast``, ``constant:a`` (deceleration in m/s2) or a ``profile``.

    ``spec`` is the text of the command, for example ``constant:3.5``. For a profile, ``act`` returns the command of the
    first phase, and the engine applies the commands of the later phases (``Worlds.play_pieces``). In the paper's
    non-ethical strategy every vehicle follows ``full_brake``. Raises ``InvalidInput`` if ``spec`` is none of these four
    commands. ``act`` raises ``InvalidInput`` for a constant command beyond the vehicle's capacity.
    """

    state_free = True
    knows = Source.SENSORS

    def __init__(self, spec: str) -> None:
        if not ScriptSpec.parse(spec).is_state_free():
            raise InvalidInput(f"agent {spec!r}: must be full_brake, coast or constant:a")
        self.name, self.braking_pieces = spec, ScriptSpec.parse(spec).pieces

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Return the fixed command for ``vehicle`` (index, 0 = front) in each of n worlds, [n] m/s2."""
        vehicles = worlds.vehicles
        command = ScriptSpec.parse(self.name).command(
            vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
        )
        assert command is not None
        return command


def make_script(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the script with the specification ``settings.spec``, such as ``constant:3.5``; ``argument`` is ignored."""
    return StateFree(settings.spec)


COAST = Part(make_script, form="coast", about="neither brake nor drive", knows=Source.SENSORS)

FULL_BRAKE = Part(
    make_script, form="full_brake", about="full braking, the paper's non-ethical strategy", knows=Source.SENSORS
)

CONSTANT = Part(
    make_script, form="constant:A", about="constant deceleration A in m/s2; a negative A drives", knows=Source.SENSORS
)

PROFILE = Part(
    make_script,
    form="profile:0=A,S=B",
    about="deceleration A at first, B after S seconds; only as a role in a scenario",
    knows=Source.SENSORS,
)

E_V2X_BM = Part(
    make_e_v2x_bm,
    form="e_v2x_bm[:pairwise]",
    about="the constant deceleration of least simulated harm; pairwise: the paper's closed form, from the true state",
    knows=Source.MODEL,
)

# Agents that ``--agents ladder`` stands for; extensions add agents to this group with entry points ``ladder.NAME``.
LADDER = ("coast", "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm")
