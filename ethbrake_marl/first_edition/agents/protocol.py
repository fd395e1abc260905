"""The interfaces of agents, teams and shields around agents, and the names of their sources of knowledge.

The attribute ``knows`` of an agent states its sources of knowledge: one ``Source`` (or its text), or several, for
example for a policy behind a shield. Lost or late messages (``v2x``) affect only agents whose sources are ``SENSORS``,
``MESSAGES`` or ``ESTIMATES``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine, Guard
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, begin_script, is_state_free
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.physics.messages import refuse_untold
from ethbrake_marl.first_edition.physics.state import Floats, Worlds


class Source(StrEnum):
    """Sources of an agent's knowledge, from little to much knowledge. Each source includes the sources before it."""

    SENSORS = "own sensors"  # the own vehicle, and the neighbours that its sensors see
    MESSAGES = "messages"  # also the messages that the vehicle has received
    ESTIMATES = "estimated model"  # also the scenario's ranges, scripts and physics, but no hidden values
    STATE = "true state"  # the true states, capacities and latencies of all vehicles, whether received or not
    MODEL = "true model"  # also masses, restitution and scripts: everything that an exact simulation needs
    UNSTATED = "not stated"  # the agent does not state its knowledge


class Knowledge(tuple[Source, ...]):
    """Sources of knowledge of one or several agents: each ``Source`` at most once, in the order of ``Source``."""

    @classmethod
    def of(cls, *agents: object, also: Source | None = None) -> Knowledge:
        """Return the combined knowledge of several agents or teams.

        For an agent without an attribute ``knows``, the source is ``UNSTATED``. ``also`` is a source of knowledge that
        a shield or search around the agents adds.

        Raises ``InvalidInput`` if the attribute ``knows`` of an agent contains an unknown source.
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
        """All sources as one text, such as ``messages + true model``, or a dash if there are no sources."""
        return " + ".join(self) or "–"

    @property
    def sees_through(self) -> bool:
        """Whether the agent is omniscient: it knows the true state or the true model, which no message contains."""
        return Source.STATE in self or Source.MODEL in self


@runtime_checkable
class Agent(Script, Protocol):
    """Interface of an agent, which drives one vehicle in each of n worlds: the interface ``Script``, and a name.

    The attribute ``knows`` may state the agent's sources of knowledge (``Source``). For an agent without this
    attribute, tables show "not stated". An agent without a memory has one method, ``act(worlds, vehicle)``:

    >>> import ethbrake_marl.first_edition as eb
    >>> class HalfBrake:
    ...     name = "half_brake"
    ...     def act(self, worlds, vehicle):
    ...         return -0.5 * worlds.vehicles.braking_capacity_mps2[:, vehicle]
    >>> isinstance(HalfBrake(), eb.Agent)
    True

    An agent must not store its memory in attributes. ``begin`` returns the first memory; ``act`` takes the memory and
    returns a new one:

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

    name: str  # name of the agent in tables and messages


def check_agent(agent: object, where: str, *, alone: bool = True) -> None:
    """Raise ``InvalidInput`` unless the object ``agent`` implements the interface ``Agent``.

    The error message begins with ``where``, for example ``agent 'mine'``. If ``alone`` is False, a team and an agent
    behind a shield are accepted as well.
    """
    if not isinstance(agent, Agent) and (alone or not isinstance(agent, Team | Shielding)):
        missing = [what for what in ("name", "act") if not hasattr(agent, what)]
        raise InvalidInput(
            f"{where}: {type(agent).__name__!r} is not an agent, because it has no {' and no '.join(missing)}; to make"
            " an agent, use make_agent(name), policy_agent(policy) for a function or a model, or"
            " LearnedAgent(load_policy(path)) for a policy bundle"
        )


ADVICE = "; to look ahead, the script must be full_brake, coast or constant:a"


def fixed_commands(
    scripts: Mapping[int, Script],
    worlds: Worlds,
    who: str,
    *,
    vehicle: int | None = None,
    is_fixed: Callable[[Script], bool] = is_state_free,
    advice: str = ADVICE,
) -> Floats:
    """Return the constant command that each vehicle has from the alert on, [n, N] m/s2, for an agent that looks ahead.

    Args:
        scripts: mapping from the index of each scripted vehicle to its script; vehicles without a script brake fully.
        worlds: n worlds at the alert.
        who: name of the agent that looks ahead; error messages begin with this name.
        vehicle: index of the vehicle that the agent drives; a script of this vehicle is ignored. None: no script is
            ignored.
        is_fixed: function that returns whether the command of a script is fixed at the alert.
        advice: end of the error message about a script whose command is not fixed at the alert.

    Raises ``InvalidInput`` for a script whose command is not fixed at the alert, if the braking profiles in ``worlds``
    differ from the profiles of the scripts, or if the messages do not contain a quantity that the agent needs to look
    ahead.

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
                f"{who}: vehicle_{i + 1} is driven by {name!r}, whose command is not fixed at the alert{advice}"
            )
        command[:, i], _ = ask_script(script, worlds, begin_script(script, worlds, i, scripts), i)
    pieces = {i: getattr(script, "braking_pieces", ()) for i, script in scripts.items() if i != vehicle}
    if not np.array_equal(worlds.play_pieces(pieces).vehicles.pieces, worlds.vehicles.pieces):
        raise InvalidInput(
            f"{who}: the braking profiles in these worlds differ from the braking profiles in the scenario's roles;"
            " draw or read the worlds with the same scenario"
        )
    return command


class ByPolicy:
    """Base class of agents whose attribute ``policy`` is a trained policy, or another agent that they wrap."""

    policy: Any  # the trained policy, or the wrapped agent

    def policy_sha256(self) -> str | None:
        """Return the SHA-256 hash of the policy; None if there is no policy, or if the policy has no hash."""
        return policy_sha256(self.policy)

    @property
    def manifest(self) -> Any:
        """Manifest (origin, network and hashes) of the policy bundle; None if the policy is not from a bundle."""
        return getattr(self.policy, "manifest", None)


def policy_sha256(agent: object) -> str | None:
    """Return the SHA-256 hash of an agent's policy, also inside a shield or search; None if there is no policy.

    The hash of a policy bundle is the hash in its manifest; this hash covers names, network and weights. The hash of a
    policy of another library covers its weights.
    """
    ask = getattr(agent, "policy_sha256", None)
    return None if ask is None else ask()


class AgentAround(ByPolicy):
    """Base class of agents that wrap another agent, the attribute ``policy``.

    By default ``begin`` and ``act`` call the wrapped agent; a subclass overrides one or both of them. The class
    attribute ``adds`` is a source of knowledge that the subclass uses in addition to the wrapped agent's sources, for
    example ``Source.MODEL``; None: no further source. If ``name`` is None, the new agent has the name of the wrapped
    agent.
    """

    adds: ClassVar[Source | None] = None

    def __init__(self, policy: Agent, name: str | None = None) -> None:
        self.policy = policy
        self.name = policy.name if name is None else name

    @property
    def knows(self) -> Knowledge:
        """Sources of knowledge of the wrapped agent, together with the source ``adds``."""
        return Knowledge.of(self.policy, also=self.adds)

    @property
    def time_step_s(self) -> float | None:
        """Time between two decisions that the wrapped agent requires (s); None: the wrapped agent accepts any time."""
        return getattr(self.policy, "time_step_s", None)

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Return the wrapped agent's initial memory."""
        return begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the wrapped agent's command for ``vehicle``, [n] m/s2, and the wrapped agent's new memory."""
        return ask_script(self.policy, worlds, memory, vehicle)


@runtime_checkable
class Shielding(Protocol):
    """Interface of an agent or team behind a shield. The method ``on`` selects the vehicles that the team drives."""

    name: str  # name of the agent or team in tables and messages

    @property
    def knows(self) -> Knowledge:
        """Sources of knowledge of the agents and of the shield together."""

    def on(self, vehicles: Collection[int]) -> Team:
        """Return a team that drives ``vehicles`` (indices, 0 = front) behind this shield."""

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """Return the guard, which checks commands in ``engine``.

        ``policies`` maps the index of each learner to the agent that proposes the learner's commands.
        """


class Team:
    """Agents that drive several vehicles of one line. Each agent uses only the knowledge of the vehicle that it drives.

    The same agent may drive several vehicles, with a separate memory for each.

    Args:
        drivers: mapping from the index of each controlled vehicle (0 = front) to its agent.
        name: name of the team in tables and messages.
        shield: shield that checks the agents' commands and may replace them; None: no shield.

    Raises ``InvalidInput`` for an invalid agent or index.

    >>> import ethbrake_marl.first_edition as eb
    >>> team = eb.Team({1: eb.make_agent("full_brake"), 2: eb.make_agent("coast")}, "mixed")
    >>> sorted(team.drivers)
    [1, 2]

    """

    def __init__(self, drivers: Mapping[int, Agent], name: str, shield: Shielding | None = None) -> None:
        for vehicle, agent in drivers.items():
            if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not vehicle >= 0:
                raise InvalidInput(f"team {name!r}: key {vehicle!r}: must be the index of a vehicle, at least 0")
            if not isinstance(agent, Agent):
                raise InvalidInput(
                    f"team {name!r}: vehicle_{vehicle + 1} = {agent!r}: must be an agent, for instance one from"
                    " make_agent"
                )
        self.drivers = {int(vehicle): drivers[vehicle] for vehicle in sorted(drivers)}
        self.name, self.shield = name, shield

    @property
    def knows(self) -> Knowledge:
        """All sources of knowledge of agents and shield; empty if the team has neither agents nor a shield."""
        return Knowledge.of(*self.drivers.values(), *(() if self.shield is None else (self.shield,)))

    @staticmethod
    def of(driver: Driver, vehicles: Collection[int]) -> Team:
        """Return the team in which ``driver`` drives the vehicles with the indices ``vehicles`` (0 = front).

        If ``driver`` is a single agent, this agent drives all of ``vehicles``. Raises ``InvalidInput`` if ``driver`` is
        a team that drives other vehicles than ``vehicles``.
        """
        if isinstance(driver, Shielding):
            return driver.on(vehicles)
        if not isinstance(driver, Team):
            return Team(dict.fromkeys(vehicles, driver), driver.name)
        if set(driver.drivers) != set(vehicles):
            theirs, wanted = (
                ", ".join(f"vehicle_{i + 1}" for i in sorted(each)) or "none" for each in (driver.drivers, vehicles)
            )
            raise InvalidInput(f"team {driver.name!r}: drives {theirs}; must drive exactly {wanted}")
        return driver


Driver = Team | Agent | Shielding  # an Agent alone drives every learner
