"""The protocol of an agent, which drives one vehicle in a whole batch of worlds."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import ClassVar, Protocol, Self, TypeGuard, runtime_checkable

import numpy as np

from ethbrake_marl.agents.knowledge import Knowledge, Source, combine
from ethbrake_marl.engine.stream import Script, ask_script, begin_script, is_state_free
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.physics import Floats, Ints, Worlds


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
