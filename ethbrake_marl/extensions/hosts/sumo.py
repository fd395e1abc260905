"""Use the traffic simulator SUMO as a host.

All worlds run in one SUMO simulation in this process, each world on a straight road of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, redirect_stdout
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.errors import AgentFailed, InvalidInput, naming_extras, need, renumbered, unknown_name
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.extensions.hosts.protocol import Host, HostCommand, Hosted, HostState, drive_host
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.physics.state import Bools, Floats, Worlds
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

_SUMO_DT_S = 0.01  # default step length

_SUMO_LENGTH_M = 5.0  # length of every vehicle; it has no effect, because gaps are from bumper to bumper

_SUMO_EDGE_M = 10_000.0

_EVERY_CHECK_OFF = 32  # SUMO's speed mode in which a vehicle takes the commanded speed without checks

_SUMO_OPTIONS = (
    *("--step-method.ballistic", "true", "--collision.action", "none", "--time-to-teleport", "-1"),
    *("--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never", "--duration-log.disable", "true"),
)


class SumoHost:
    """Host that runs worlds as parallel roads of one SUMO simulation. A process can run only one simulation at a time.

    At the end of each step, every vehicle has exactly the speed that its command requires. SUMO integrates the motion
    with its ballistic method, and lets vehicles pass through one another. SUMO has no negative speeds, so a vehicle
    that should move backwards after an impact stands still.

    Args:
        worlds: the worlds at the alert.
        dt: step length (s), a whole number of milliseconds.

    Raises ``MissingExtra`` if libsumo is not installed. Raises ``InvalidInput`` if ``dt`` is not a whole number of
    milliseconds, or if another SUMO simulation is open in this process.

    """

    def __init__(self, worlds: Worlds, dt: float = _SUMO_DT_S) -> None:
        with naming_extras(), redirect_stdout(StringIO()):  # libsumo prints a warning about another library's version
            import libsumo
        if not (dt >= 0.001 and abs(1000.0 * dt - round(1000.0 * dt)) < 1e-9):
            raise InvalidInput(
                f"sumo: dt = {dt!r}: the step length must be a whole number of milliseconds, for instance 0.01 s"
            )
        if libsumo.isLoaded():
            raise InvalidInput(
                "sumo: another SUMO simulation is open in this process, but only one is possible; close() it first"
            )
        self.dt, self._sumo = float(dt), libsumo
        self._names = [[f"{k}.{i}" for i in range(worlds.N)] for k in range(worlds.n)]
        with TemporaryDirectory() as folder:
            net, routes = Path(folder, "net.xml"), Path(folder, "routes.xml")
            net.write_text(_net(worlds.n), "utf-8")
            routes.write_text(_routes(worlds, self._names), "utf-8")
            files = ("--net-file", str(net), "--route-files", str(routes))
            libsumo.start(["sumo", *files, "--step-length", repr(self.dt), *_SUMO_OPTIONS])
        libsumo.simulationStep()  # the first step creates the vehicles at their positions and speeds
        for name in (name for line in self._names for name in line):
            libsumo.vehicle.setSpeedMode(name, _EVERY_CHECK_OFF)
        self._speeds: Floats = np.array(self.state().speeds_mps)

    def state(self) -> HostState:
        """Return time, gaps and speeds as SUMO reports them."""
        vehicle = self._sumo.vehicle
        place = np.array([[vehicle.getLanePosition(name) for name in line] for line in self._names])
        self._speeds = np.array([[vehicle.getSpeed(name) for name in line] for line in self._names])
        gaps = place[:, :-1] - _SUMO_LENGTH_M - place[:, 1:]
        return HostState(self._sumo.simulation.getTime(), gaps, self._speeds)

    def apply(self, command: HostCommand) -> None:
        """Compute the speed of each vehicle at the end of the step, and let SUMO make the step."""
        vehicle, begin = self._sumo.vehicle, np.maximum(command.speeds_mps, 0.0)
        end = np.maximum(command.speeds_mps + command.acceleration_mps2 * self.dt, 0.0)
        for k, line in enumerate(self._names):
            for i, name in enumerate(line):
                if begin[k, i] != self._speeds[k, i]:
                    vehicle.setPreviousSpeed(name, float(begin[k, i]))
                vehicle.setSpeed(name, float(end[k, i]))
        self._sumo.simulationStep()

    def close(self) -> None:
        """End the SUMO simulation, so that this process can start another simulation."""
        self._sumo.close()


def _net(edges: int) -> str:
    """Return the XML of SUMO's network: ``edges`` parallel straight roads with one lane, one for each world."""
    lines = []
    for k in range(edges):
        y = 10.0 * k
        lines.append(
            f'<edge id="{k}" from="a{k}" to="b{k}"><lane id="{k}_0" index="0" speed="200" length="{_SUMO_EDGE_M}"'
            f' shape="0,{y} {_SUMO_EDGE_M},{y}"/></edge>'
        )
    for k in range(edges):
        for end, x, lanes in (("a", 0.0, ""), ("b", _SUMO_EDGE_M, f"{k}_0")):
            lines.append(
                f'<junction id="{end}{k}" type="dead_end" x="{x}" y="{10.0 * k}" incLanes="{lanes}" intLanes=""'
                f' shape="{x},{10.0 * k}"/>'
            )
    return "\n".join(['<net version="1.20">', *lines, "</net>"])


def _routes(worlds: Worlds, names: Sequence[Sequence[str]]) -> str:
    """Return the XML of SUMO's routes file, with the positions and speeds of all vehicles at the alert.

    The last vehicle of each line begins at one tenth of the length of its road. ``names`` are SUMO's names of the
    vehicles of each world, front to rear.
    """
    lines = [
        f'<vType id="v" length="{_SUMO_LENGTH_M}" minGap="0" tau="0.001" sigma="0" accel="1000" decel="1000"'
        ' emergencyDecel="1000" maxSpeed="200"/>'
    ]
    lines += [f'<route id="{k}" edges="{k}"/>' for k in range(worlds.n)]
    behind = np.cumsum(worlds.gaps_m[:, ::-1] + _SUMO_LENGTH_M, axis=1)[:, ::-1]
    place = (_SUMO_EDGE_M / 10.0 + np.concatenate([behind, np.zeros((worlds.n, 1))], axis=1)).tolist()
    speeds = worlds.speeds_mps.tolist()
    for k, line in enumerate(names):
        lines += [
            f'<vehicle id="{name}" type="v" route="{k}" depart="0" departPos="{place[k][i]!r}" insertionChecks="none"'
            f' departSpeed="{speeds[k][i]!r}"/>'
            for i, name in enumerate(line)
        ]
    return "\n".join(["<routes>", *lines, "</routes>"])


class FoundHost(NamedTuple):
    """Kind of host with its settings; ``evaluate`` evaluates agents in it."""

    name: str  # name and version of the simulator, for tables
    # function that starts a host with worlds at the alert, as a context manager
    open: Callable[[Worlds], AbstractContextManager[Host]]

    def evaluate(
        self,
        sample: Sample,
        agents: Mapping[str, Driver],
        scenario: Scenario,
        seed: int | None,
        *,
        at_once: int = 100,
        on_progress: Callable[[str, int], None] = lambda agent, done: None,
    ) -> tuple[Evaluation, dict[str, Bools | None]]:
        """Let one agent after the other drive the scenario's learners in SUMO, each in the same worlds.

        ``seed`` is stored in the evaluation. ``at_once`` is the largest number of worlds in one simulation.
        ``on_progress`` is called with the name of an agent and the number of worlds that it has finished.

        Returns the evaluation, and ``Hosted.distrusted`` of each agent by name.
        """
        results: dict[str, Hosted] = {}
        for spec, agent in agents.items():
            parts = []
            for first in range(0, sample.worlds.n, at_once):
                rows = np.arange(first, min(first + at_once, sample.worlds.n))
                worlds = sample.worlds.take(rows)
                with renumbered(rows), AgentFailed.naming(spec), self.open(worlds) as host:
                    parts.append(drive_host(host, agent, scenario, worlds))
                on_progress(spec, int(rows[-1]) + 1)
            results[spec] = Hosted.join(parts)
        outcomes = {spec: each.outcome for spec, each in results.items()}
        whole = Evaluation(
            scenario, scenario.learners, sample.worlds, sample.index, seed, outcomes, kinds=sample.kinds, host=self.name
        )
        return whole, {spec: each.distrusted for spec, each in results.items()}


def find_host(spec: str) -> FoundHost:
    """Return the kind of host that ``spec`` names: ``sumo``, or ``sumo:0.05`` with the step length in s.

    Raises ``UnknownName`` for an unknown host, ``InvalidInput`` for an invalid step length, and ``MissingExtra`` if
    libsumo is not installed.
    """
    name, colon, text = spec.partition(":")
    if name != "sumo":
        raise unknown_name("host", name, ("sumo",))
    dt = parse_numeral(text) if colon else _SUMO_DT_S
    if dt is None:
        raise InvalidInput(
            f"host {spec!r}: {text!r} is not a step length; give a number of seconds, for instance sumo:{_SUMO_DT_S:g}"
        )
    need("libsumo")
    return FoundHost(f"SUMO {version('libsumo')}, steps of {dt:g} s", lambda worlds: closing(SumoHost(worlds, dt)))
