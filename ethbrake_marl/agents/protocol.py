"""The interfaces of agents, teams and shielded drivers, and the terms for what they know about the line.

An agent states its knowledge in an attribute ``knows``: a ``Source``, its name, or several if its parts know different
things (a shield around a policy). A channel (``v2x``) hides information from the first three sources only.
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
from ethbrake_marl.physics.messages import refuse_untold
from ethbrake_marl.physics.state import Floats, Worlds


class Source(StrEnum):
    """Source of knowledge, from least to most; each includes the sources before it."""

    SENSORS = "own sensors"  # the own vehicle, and the neighbours that its sensors see
    MESSAGES = "messages"  # the messages that have reached it
    ESTIMATES = "estimated model"  # also the scenario's ranges, scripts and physics, but no hidden values
    STATE = "true state"  # the other vehicles' true states, capacities and latencies, received or not
    MODEL = "true model"  # also masses, restitution, scripts: all that an exact simulation of the line needs
    UNSTATED = "not stated"  # the agent does not state its knowledge


class Knowledge(tuple[Source, ...]):
    """Set of sources of knowledge: a tuple of ``Source`` values in increasing order, each once."""

    @classmethod
    def of(cls, *agents: object, also: Source | None = None) -> Knowledge:
        """Return the combined knowledge of several agents or teams.

        Args:
            agents: agents or teams; one without an attribute ``knows`` counts as ``UNSTATED``.
            also: knowledge that a shield or search around them adds; None: none.

        Raises ``InvalidInput`` for an unknown source.

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
        """The sources as one text, such as ``messages + true model``; a dash if there are none."""
        return " + ".join(self) or "–"

    @property
    def sees_through(self) -> bool:
        """Whether the true state or the true model, which no message or sensor delivers, is among the sources."""
        return Source.STATE in self or Source.MODEL in self


@runtime_checkable
class Agent(Script, Protocol):
    """A ``Script`` with a name: drives one vehicle in every world of a batch of ``n``.

    Its attribute ``knows`` states what it knows about the line (``Source``); without it tables say "not stated".
    An agent without a memory has only ``act(worlds, vehicle)``:

    >>> import ethbrake_marl as eb
    >>> class HalfBrake:
    ...     name = "half_brake"
    ...     def act(self, worlds, vehicle):
    ...         return -0.5 * worlds.vehicles.braking_capacity_mps2[:, vehicle]
    >>> isinstance(HalfBrake(), eb.Agent)
    True

    The memory of an agent is a value that ``begin`` creates and ``act`` takes and returns, never an attribute:

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

    name: str  # name in tables and messages


def check_agent(agent: object, where: str, *, alone: bool = True) -> None:
    """Raise ``InvalidInput`` unless ``agent`` is an agent.

    Args:
        agent: any object.
        where: beginning of the error message, for example ``agent 'mine'``.
        alone: accept only an agent for one vehicle; if False, also a team or a driver behind a shield.

    """
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
    """Return every vehicle's constant command from the alert on, [n, N] m/s2, for an agent that looks ahead.

    Args:
        scripts: index of each scripted vehicle -> its script; vehicles without a script brake fully.
        worlds: n worlds at the alert.
        who: name of the agent that looks ahead; errors begin with it.
        vehicle: index of the vehicle that this agent drives, whose script is ignored; None: none.
        is_fixed: whether the command of a script is fixed at the alert.
        advice: end of the error message.

    Raises ``InvalidInput`` for a script whose command is not fixed at the alert, for worlds whose braking profiles are
    not those of the scripts, and where messages lack a piece that looking ahead needs.

    """
    if vehicle is not None:
        refuse_untold(worlds, [vehicle], who)
    command = -worlds.vehicles.braking_capacity_mps2
    for i, script in scripts.items():
        if i == vehicle:
            continue
        if not is_fixed(script):
            name = getattr(script, "name", type(script).__name__)
            raise InvalidInput(
                f"{who}: vehicle_{i + 1} is controlled by {name!r}, whose command is not fixed at the alert{advice}"
            )
        command[:, i], _ = ask_script(script, worlds, begin_script(script, worlds, i, scripts), i)
    pieces = {i: getattr(script, "braking_pieces", ()) for i, script in scripts.items() if i != vehicle}
    if not np.array_equal(worlds.play_pieces(pieces).vehicles.pieces, worlds.vehicles.pieces):
        raise InvalidInput(
            f"{who}: a profile: the pieces in which vehicles brake in these worlds are not those of its scripts; draw"
            " or read the worlds with the same scenario"
        )
    return command


class ByPolicy:
    """Base class of agents with an attribute ``policy``: a trained policy, or another agent that the agent wraps.

    It derives the hash and the manifest from ``policy``, which a subclass sets; nothing has to be overridden.
    """

    policy: Any  # the trained policy, or the wrapped agent

    def policy_sha256(self) -> str | None:
        """Return the SHA-256 of the policy; None without a policy, or if the policy has no hash."""
        return policy_sha256(self.policy)

    @property
    def manifest(self) -> Any:
        """Manifest of the policy's bundle (its origin, network and hashes); None for a policy without a bundle."""
        return getattr(self.policy, "manifest", None)


def policy_sha256(agent: object) -> str | None:
    """Return the SHA-256 of the policy that an agent uses, also inside shields and searches; None without a policy.

    For a policy bundle it is the hash in its manifest, which covers names, network and weights. For a policy of another
    library it is the hash of its weights.
    """
    ask = getattr(agent, "policy_sha256", None)
    return None if ask is None else ask()


class AgentAround(ByPolicy):
    """Base class of agents that wrap another agent, called ``policy``.

    By default everything is passed to the wrapped agent. A subclass overrides ``begin``, ``act`` or both. The class
    attribute ``adds`` is the knowledge that it has beyond the wrapped agent's, for example ``Source.MODEL``; None: no
    more. ``name`` is the new agent's name; None: the wrapped agent's name.
    """

    adds: ClassVar[Source | None] = None

    def __init__(self, policy: Agent, name: str | None = None) -> None:
        self.policy = policy
        self.name = policy.name if name is None else name

    @property
    def knows(self) -> Knowledge:
        """Knowledge of the wrapped agent, plus ``adds``."""
        return Knowledge.of(self.policy, also=self.adds)

    @property
    def time_step_s(self) -> float | None:
        """Time between two decisions that the wrapped agent requires (s); None: any."""
        return getattr(self.policy, "time_step_s", None)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Return the wrapped agent's initial memory.

        Args:
            alert: n worlds at the alert.
            vehicle: index of the controlled vehicle (0 = front).
            scripts: index of each scripted vehicle -> its script.

        """
        return begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the wrapped agent's command for ``vehicle``, [n] m/s2, and its new memory."""
        return ask_script(self.policy, worlds, memory, vehicle)


@runtime_checkable
class Shielding(Protocol):
    """Interface of an agent or team behind a shield, before it is known which vehicles it drives."""

    name: str  # name in tables and messages

    @property
    def knows(self) -> Knowledge:
        """Combined knowledge of the agents and the shield."""

    def on(self, vehicles: Collection[int]) -> Team:
        """Return the team, with this shield, that drives the vehicles with these indices (0 = front)."""

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """Return the shield's part that checks commands in ``engine``.

        ``policies`` maps the index of each learner to the agent that proposes its commands.
        """


class Team:
    """One agent per controlled vehicle (index, 0 = front); each decides from what its own vehicle knows.

    Behind a ``shield`` the agents only propose. One agent may drive several vehicles, with a separate memory for each.
    Raises ``InvalidInput`` for an invalid agent or index.

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
                raise InvalidInput(
                    f"team {name!r}: vehicle_{vehicle + 1} is controlled by {agent!r}, which is no agent"
                )
        self.drivers = {int(vehicle): drivers[vehicle] for vehicle in sorted(drivers)}
        self.name, self.shield = name, shield

    @property
    def knows(self) -> Knowledge:
        """Combined knowledge of the agents and the shield; empty for a team without agents."""
        return Knowledge.of(*self.drivers.values(), *(() if self.shield is None else (self.shield,)))

    @staticmethod
    def of(driver: Driver, vehicles: Collection[int]) -> Team:
        """Return the team in which ``driver`` drives the vehicles with the indices ``vehicles`` (0 = front).

        A single agent drives all of them. Raises ``InvalidInput`` for a team that drives other vehicles.
        """
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


Driver = Team | Agent | Shielding  # a single agent drives every learner
