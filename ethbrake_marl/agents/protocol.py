"""The protocol of an agent, which drives one vehicle in a whole batch of worlds."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from enum import StrEnum
from typing import ClassVar, Protocol, Self, TypeGuard, runtime_checkable

import numpy as np

from ethbrake_marl.engine.engine import Engine, Guard
from ethbrake_marl.engine.stream import Script, ask_script, begin_script, is_state_free
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.physics import Floats, Ints, Worlds

# The vocabulary in which every agent states what it knows of the line while it drives.
#
# An agent says it with an attribute ``knows``: one ``Source``, its name, or several where parts of it know different
# things (a shield around a policy). A channel (``v2x``) hides things from the first three sources only.


class Source(StrEnum):
    """Where knowledge comes from, least first; each has what stands before it as well."""

    SENSORS = "own sensors"  # its own vehicle, and the neighbours that its sensors see
    MESSAGES = "messages"  # the messages that have reached it
    BELIEFS = "believed model"  # also what the scenario says of all lines: ranges, scripts, physics; nothing hidden
    STATE = "true state"  # the others' states, capacities and latencies as they are, received or not
    MODEL = "true model"  # also masses, restitution, every script: enough to roll the line forward in the same physics
    UNSTATED = "not stated"  # of an agent that does not say


Knowledge = tuple[Source, ...]  # in the order of the vocabulary, each once

_SEES_THROUGH = frozenset({Source.STATE, Source.MODEL})


def knowledge_of(agent: object) -> Knowledge:
    """What an agent, or a team, says it knows; ``UNSTATED`` if it says nothing.

    Raises ``InvalidInput`` for a word that is not in the vocabulary.
    """
    stated = getattr(agent, "knows", None)
    words = (Source.UNSTATED,) if stated is None else (stated,) if isinstance(stated, str) else stated
    try:
        found = {Source(word) for word in words}
    except (TypeError, ValueError):
        name = getattr(agent, "name", type(agent).__name__)
        right = ", ".join(repr(source.value) for source in Source)
        raise InvalidInput(f"agent {name!r}: knows = {stated!r:.200}: must be one or several of {right}") from None
    return tuple(source for source in Source if source in found)


def combine(*agents: object, also: Source | None = None) -> Knowledge:
    """What several agents know between them, and what a wrapper around them knows ``also``."""
    known = {source for agent in agents for source in knowledge_of(agent)} | ({also} if also else set())
    return tuple(source for source in Source if source in known)


def sees_through(knowledge: Knowledge) -> bool:
    """Whether it reads of the line what no channel brought."""
    return not _SEES_THROUGH.isdisjoint(knowledge)


def knowledge_text(knowledge: Knowledge) -> str:
    """``messages + true model``; a dash for nothing, which is what a team of nobody knows."""
    return " + ".join(knowledge) or "–"


@runtime_checkable
class Agent(Script, Protocol):
    """A ``Script`` with a name: ``begin`` and ``act`` for one vehicle in every world of a batch of ``n``.

    It says with ``knows`` what it knows of the line (``agents.knowledge``); without it tables say "not stated".

    >>> import ethbrake_marl as eb
    >>> class HalfBrake:
    ...     name = "half_brake"
    ...     def begin(self, worlds, vehicle, rows):
    ...         pass
    ...     def act(self, worlds, vehicle):
    ...         return -0.5 * worlds.vehicles.braking_capacity_mps2[:, vehicle]
    >>> isinstance(HalfBrake(), eb.Agent)
    True

    """

    name: str


@runtime_checkable
class PredictingAgent(Protocol):
    """An agent that also states, when an episode begins, which harm it expects."""

    predicted_harm: Floats  # [n] m2/s2, filled by ``begin``


@runtime_checkable
class LookingAhead(Protocol):
    """An agent whose choice depends on what the other vehicles do; whoever knows their scripts sets them."""

    others: Mapping[int, Script]  # by vehicle index; vehicles without an entry brake fully


@runtime_checkable
class Divisible(Protocol):
    """An agent that can go on apart, in some worlds of its batch only."""

    def take(self, rows: Ints) -> Agent:
        """An agent with this one's memory of these rows; what it does leaves this one as it is."""
        ...


def check_agent(agent: object, where: str) -> None:
    """Raise ``InvalidInput`` for what is not an agent."""
    if not isinstance(agent, Agent):
        missing = [what for what in ("name", "begin", "act") if not hasattr(agent, what)]
        raise InvalidInput(
            f"{where}: {type(agent).__name__!r} is no agent: it has no {' and no '.join(missing)};"
            " make_agent(name) makes one, policy_agent(policy) one of a function or a model, and"
            " LearnedAgent(load_policy(path)) one of a policy bundle"
        )


def place(stored: Floats, rows: Ints, values: Floats) -> Floats:
    """Per-world values [k, ...] after new episodes in ``rows``; grows to the largest row, NaN where none began yet."""
    size = max(len(stored), int(rows.max(initial=-1)) + 1)
    placed = np.full((size, *values.shape[1:]), np.nan)
    if len(stored):
        placed[: len(stored)] = stored
    placed[rows] = values
    return placed


def recall(stored: Floats, n: int, name: str) -> Floats:
    """The values of a batch of ``n`` (own memory). Raises ``InvalidInput`` if an episode in it never began."""
    values = stored[:n].copy()
    if len(values) < n or not np.all(np.isfinite(values)):
        raise InvalidInput(f"agent {name!r}: act on {count_of(n, 'world')}, but begin was not called for each of them")
    return values


ADVICE = "; looking ahead needs full_brake, coast, constant:a, copy_leader or gentlest_front"


def fixed_commands(
    others: Mapping[int, Script],
    worlds: Worlds,
    who: str,
    *,
    vehicle: int | None = None,
    is_fixed: Callable[[Script], bool] = is_state_free,
    advice: str = ADVICE,
) -> Floats:
    """The command of every vehicle from the alert on, [n, N] m/s2; those without an entry in ``others`` brake fully.

    ``worlds`` are at the alert. ``who`` looks ahead and drives ``vehicle``, which is left out. Raises ``InvalidInput``
    (first ``who``, at its end ``advice``) for a script whose command is not fixed at the alert, as ``is_fixed`` says.
    """
    command = -worlds.vehicles.braking_capacity_mps2
    for i, script in others.items():
        if i == vehicle:
            continue
        if not is_fixed(script):
            name = getattr(script, "name", type(script).__name__)
            raise InvalidInput(
                f"{who}: vehicle_{i + 1} is driven by {name!r}, whose command is not fixed at the alert{advice}"
            )
        asked = copy.deepcopy(script)  # what it remembers of running episodes is not disturbed
        begin_script(asked, worlds, i, np.arange(worlds.n))
        command[:, i] = asked.act(worlds, i)
    return command


class AgentAround:
    """Base of agents that are put around a ``policy``, which is any agent: each says only what it does differently.

    ``adds`` is what it knows beside what the policy knows. ``divides_along`` names its own arrays [n, ...], row k for
    row k of the batch, which go with their worlds in ``take``; None where it cannot go on in some worlds only.
    """

    adds: ClassVar[Source | None] = None
    divides_along: ClassVar[tuple[str, ...] | None] = None

    def __init__(self, policy: Agent, name: str | None = None) -> None:
        self.policy = policy
        self.name = policy.name if name is None else name

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and what this adds."""
        return combine(self.policy, also=self.adds)

    @property
    def others(self) -> Mapping[int, Script]:
        """The scripts of the other vehicles, for a policy that looks ahead."""
        return self.policy.others if isinstance(self.policy, LookingAhead) else {}

    @others.setter
    def others(self, scripts: Mapping[int, Script]) -> None:
        if isinstance(self.policy, LookingAhead):
            self.policy.others = scripts

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """As the policy."""
        begin_script(self.policy, worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """As the policy, [n] m/s2."""
        return ask_script(self.policy, worlds, vehicle)

    def take(self, rows: Ints) -> Self:
        """A copy that drives on in some rows of its batch only; raises ``InvalidInput`` if it or the policy cannot."""
        if self.divides_along is None or not is_divisible(self.policy):
            who = self.name if self.divides_along is None else self.policy.name
            raise InvalidInput(f"{self.name}: {who} has no take(rows), so it cannot go on in some worlds")
        part = copy.copy(self)
        part.policy = self.policy.take(rows)
        for name in self.divides_along:
            setattr(part, name, getattr(self, name)[rows])
        return part


def is_divisible(agent: Agent) -> TypeGuard[Divisible]:
    """Whether an agent can go on in some worlds apart; one around an agent can where both can."""
    if isinstance(agent, AgentAround):
        return agent.divides_along is not None and is_divisible(agent.policy)
    return isinstance(agent, Divisible)


def apart(agent: Agent) -> Agent:
    """A copy that can be asked without changing this one; an agent that remembers nothing is its own copy."""
    return agent if is_state_free(agent) or not getattr(agent, "remembers", True) else copy.deepcopy(agent)


def begun_apart(
    agents: Mapping[int, Agent], alert: Worlds, rows: Ints, scripts: Mapping[int, Script]
) -> dict[int, Agent]:
    """Copies of agents, by vehicle, once episodes start in these rows; ``scripts`` drive the other vehicles."""
    begun = {i: copy.deepcopy(a) if getattr(a, "remembers", True) else a for i, a in agents.items()}
    for vehicle, agent in begun.items():
        if isinstance(agent, LookingAhead):
            agent.others = {i: script for i, script in scripts.items() if i != vehicle}
        begin_script(agent, alert, vehicle, rows)
    return begun


# Teams: one agent for each of several vehicles.


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

    Behind a ``shield`` they only propose. One object cannot drive two vehicles, because it may remember its episodes:
    ``copies`` makes a team of one agent.
    Raises ``InvalidInput`` for what is not an agent, an index that is no whole number from 0, or one object twice.

    >>> import ethbrake_marl as eb
    >>> team = eb.Team({1: eb.make_agent("full_brake"), 2: eb.make_agent("copy_leader")}, "mixed")
    >>> sorted(team.drivers)
    [1, 2]

    """

    def __init__(self, drivers: Mapping[int, Agent], name: str, shield: Shielding | None = None) -> None:
        for vehicle, agent in drivers.items():
            if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not vehicle >= 0:
                raise InvalidInput(f"team {name!r}: {vehicle!r}: must be the index of a vehicle, 0 or more")
            if not isinstance(agent, Agent):
                raise InvalidInput(f"team {name!r}: vehicle_{vehicle + 1} is driven by {agent!r}, which is no agent")
        if len({id(agent) for agent in drivers.values()}) < len(drivers):
            raise InvalidInput(
                f"team {name!r}: one object drives two vehicles; Team.copies gives each vehicle its own copy"
            )
        self.drivers = {int(vehicle): drivers[vehicle] for vehicle in sorted(drivers)}
        self.name, self.shield = name, shield

    @property
    def knows(self) -> Knowledge:
        """What its drivers know between them, behind its shield; nothing where nobody is driven."""
        return combine(*self.drivers.values(), *(() if self.shield is None else (self.shield,)))

    @classmethod
    def copies(cls, agent: Agent, vehicles: Collection[int]) -> Team:
        """A team in which each of ``vehicles`` is driven by its own copy of ``agent``."""
        return cls({vehicle: copy.deepcopy(agent) for vehicle in vehicles}, agent.name)


Driver = Team | Agent | Shielding  # an agent alone drives every learner, each by its own copy


def team_of(driver: Driver, learners: Collection[int]) -> Team:
    """Fresh copies, one for each of the ``learners``. Raises ``InvalidInput`` for a team of other vehicles."""
    if isinstance(driver, Shielding):
        return driver.on(learners)
    if not isinstance(driver, Team):
        return Team.copies(driver, learners)
    if set(driver.drivers) != set(learners):
        raise InvalidInput(
            f"team {driver.name!r} drives {_names(driver.drivers)}; the vehicles to drive are {_names(learners)}"
        )
    return copy.deepcopy(driver)


def _names(vehicles: Collection[int]) -> str:
    return ", ".join(f"vehicle_{i + 1}" for i in sorted(vehicles)) or "none"
