"""The vocabulary in which every agent states what it knows of the line while it drives.

An agent says it with an attribute ``knows``: one ``Source``, its name, or several where parts of it know different
things (a shield around a policy). A channel (``v2x``) hides things from the first three sources only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from ethbrake_marl.engine.engine import Engine, Guard
from ethbrake_marl.engine.memory import Memory, ask_script, begin_script, is_state_free
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Floats, Worlds


class Source(StrEnum):
    """Where knowledge comes from, least first; each has what stands before it as well."""

    SENSORS = "own sensors"  # its own vehicle, and the neighbours that its sensors see
    MESSAGES = "messages"  # the messages that have reached it
    BELIEFS = "believed model"  # also what the scenario says of all lines: ranges, scripts, physics; nothing hidden
    STATE = "true state"  # the others' states, capacities and latencies as they are, received or not
    MODEL = "true model"  # also masses, restitution, every script: enough to roll the line forward in the same physics
    UNSTATED = "not stated"  # of an agent that does not say


class Knowledge(tuple[Source, ...]):
    """Sources in the order of the vocabulary, each once."""

    @classmethod
    def of(cls, *agents: object, also: Source | None = None) -> Knowledge:
        """What agents or teams say they know between them, and what a wrapper around them knows ``also``.

        ``UNSTATED`` of one that says nothing. Raises ``InvalidInput`` for a word that is not in the vocabulary.
        """
        known = set() if also is None else {also}
        for agent in agents:
            stated = getattr(agent, "knows", None)
            words = (Source.UNSTATED,) if stated is None else (stated,) if isinstance(stated, str) else stated
            try:
                known |= {Source(word) for word in words}
            except (TypeError, ValueError):
                name = getattr(agent, "name", type(agent).__name__)
                right = ", ".join(repr(source.value) for source in Source)
                raise InvalidInput(
                    f"agent {name!r}: knows = {stated!r:.200}: must be one or several of {right}"
                ) from None
        return cls(source for source in Source if source in known)

    @property
    def text(self) -> str:
        """``messages + true model``; a dash for nothing, which is what a team of nobody knows."""
        return " + ".join(self) or "–"

    @property
    def sees_through(self) -> bool:
        """Whether it reads of the line what no channel brought."""
        return Source.STATE in self or Source.MODEL in self


@runtime_checkable
class Agent(Script, Protocol):
    """A ``Script`` with a name: it drives one vehicle in every world of a batch of ``n``.

    It says with ``knows`` what it knows of the line (``agents.registry.Source``); without it tables say "not stated".
    One that remembers nothing has ``act(worlds, vehicle)`` alone:

    >>> import ethbrake_marl as eb
    >>> class HalfBrake:
    ...     name = "half_brake"
    ...     def act(self, worlds, vehicle):
    ...         return -0.5 * worlds.vehicles.braking_capacity_mps2[:, vehicle]
    >>> isinstance(HalfBrake(), eb.Agent)
    True

    What one remembers of its episodes is a value that it is given and gives back, never an attribute:

    >>> class OnceHit:
    ...     name = "once_hit"
    ...     def begin(self, alert, vehicle, scripts):
    ...         return alert.pair_hit.any(axis=1)
    ...     def act(self, worlds, memory, vehicle):
    ...         memory = memory | worlds.pair_hit.any(axis=1)
    ...         return -1.0 * memory * worlds.vehicles.braking_capacity_mps2[:, vehicle], memory
    >>> scenario = eb.load_scenario("paper-random")
    >>> eb.evaluate(scenario.sample(5, 7), {"hit": OnceHit()}, scenario=scenario).worlds.n
    5

    """

    name: str


def check_agent(agent: object, where: str, *, alone: bool = True) -> None:
    """Raise ``InvalidInput`` for what is not an agent; unless ``alone``, what drives several vehicles will do, too."""
    if not isinstance(agent, Agent) and (alone or not isinstance(agent, Team | Shielding)):
        missing = [what for what in ("name", "act") if not hasattr(agent, what)]
        raise InvalidInput(
            f"{where}: {type(agent).__name__!r} is no agent: it has no {' and no '.join(missing)};"
            " make_agent(name) makes one, policy_agent(policy) one of a function or a model, and"
            " LearnedAgent(load_policy(path)) one of a policy bundle"
        )


ADVICE = "; looking ahead needs full_brake, coast or constant:a"


def fixed_commands(
    scripts: Mapping[int, Script],
    worlds: Worlds,
    who: str,
    *,
    vehicle: int | None = None,
    is_fixed: Callable[[Script], bool] = is_state_free,
    advice: str = ADVICE,
) -> Floats:
    """The command of every vehicle from the alert on, [n, N] m/s2; those without an entry in ``scripts`` brake fully.

    ``worlds`` are at the alert. ``who`` looks ahead and drives ``vehicle``, which is left out. Raises ``InvalidInput``
    (first ``who``, at its end ``advice``) for a script whose command is not fixed at the alert, as ``is_fixed`` says.
    """
    command = -worlds.vehicles.braking_capacity_mps2
    for i, script in scripts.items():
        if i == vehicle:
            continue
        if not is_fixed(script):
            name = getattr(script, "name", type(script).__name__)
            raise InvalidInput(
                f"{who}: vehicle_{i + 1} is driven by {name!r}, whose command is not fixed at the alert{advice}"
            )
        command[:, i], _ = ask_script(script, worlds, begin_script(script, worlds, i, scripts), i)
    told = {i: getattr(script, "braking_pieces", ()) for i, script in scripts.items() if i != vehicle}
    if not np.array_equal(worlds.play_pieces(told).vehicles.pieces, worlds.vehicles.pieces):
        raise InvalidInput(
            f"{who}: a profile: the pieces in which vehicles brake in these worlds are not those of its scripts; draw"
            " or read the worlds with the same scenario"
        )
    return command


class ByPolicy:
    """Base of what drives by a ``policy``, or is around an agent that does: it says which policy that is."""

    policy: Any

    def policy_sha256(self) -> str | None:
        """Hash of the policy; None where no policy drives, or none that says its hash."""
        return policy_sha256(self.policy)

    @property
    def manifest(self) -> Any:
        """Manifest of the policy; None without one."""
        return getattr(self.policy, "manifest", None)


def policy_sha256(agent: object) -> str | None:
    """Hash of the policy that an agent drives by, inside whatever is around it; None without one.

    A policy bundle's is the hash in its manifest, which binds names, network and weights. A policy of another library
    has the hash of its weights.
    """
    ask = getattr(agent, "policy_sha256", None)
    return None if ask is None else ask()


class AgentAround(ByPolicy):
    """Base of agents that are put around a ``policy``, which is any agent: each says only what it does differently.

    ``adds`` is what it knows beside what the policy knows. Without a memory of its own it has that of the policy.
    """

    adds: ClassVar[Source | None] = None

    def __init__(self, policy: Agent, name: str | None = None) -> None:
        self.policy = policy
        self.name = policy.name if name is None else name

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and what this adds."""
        return Knowledge.of(self.policy, also=self.adds)

    @property
    def time_step_s(self) -> float | None:
        """The policy's, s; None: it goes by any."""
        return getattr(self.policy, "time_step_s", None)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """As the policy."""
        return begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """As the policy, [n] m/s2."""
        return ask_script(self.policy, worlds, memory, vehicle)


@runtime_checkable
class Shielding(Protocol):
    """A driver behind a shield, on no vehicle yet."""

    name: str

    @property
    def knows(self) -> Knowledge:
        """What it knows, the shield included."""

    def on(self, vehicles: Collection[int]) -> Team:
        """The team that drives these vehicles."""

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """The shield in an engine in which these vehicles learn, who proposes for them, by vehicle."""


class Team:
    """One agent for each driven vehicle (index, 0 = front). Each decides for its own vehicle, from what that one knows.

    Behind a ``shield`` they only propose. One agent may drive several vehicles: what it remembers of each is apart.
    Raises ``InvalidInput`` for what is not an agent, or an index that is no whole number from 0.

    >>> import ethbrake_marl as eb
    >>> team = eb.Team({1: eb.make_agent("full_brake"), 2: eb.make_agent("coast")}, "mixed")
    >>> sorted(team.drivers)
    [1, 2]

    """

    def __init__(self, drivers: Mapping[int, Agent], name: str, shield: Shielding | None = None) -> None:
        for vehicle, agent in drivers.items():
            if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not vehicle >= 0:
                raise InvalidInput(f"team {name!r}: {vehicle!r}: must be the index of a vehicle, 0 or more")
            if not isinstance(agent, Agent):
                raise InvalidInput(f"team {name!r}: vehicle_{vehicle + 1} is driven by {agent!r}, which is no agent")
        self.drivers = {int(vehicle): drivers[vehicle] for vehicle in sorted(drivers)}
        self.name, self.shield = name, shield

    @property
    def knows(self) -> Knowledge:
        """What its drivers know between them, behind its shield; nothing where nobody is driven."""
        return Knowledge.of(*self.drivers.values(), *(() if self.shield is None else (self.shield,)))

    @staticmethod
    def of(driver: Driver, vehicles: Collection[int]) -> Team:
        """Who drives each of the ``vehicles``, an agent alone all of them; raises ``InvalidInput`` for another team."""
        if isinstance(driver, Shielding):
            return driver.on(vehicles)
        if not isinstance(driver, Team):
            return Team(dict.fromkeys(vehicles, driver), driver.name)
        if set(driver.drivers) != set(vehicles):
            theirs, wanted = (
                ", ".join(f"vehicle_{i + 1}" for i in sorted(each)) or "none" for each in (driver.drivers, vehicles)
            )
            raise InvalidInput(f"team {driver.name!r} drives {theirs}; the vehicles to drive are {wanted}")
        return driver


Driver = Team | Agent | Shielding  # an agent alone drives every learner
