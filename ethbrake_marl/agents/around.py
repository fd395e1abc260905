"""An agent around an agent: what it does not change is handed on to the one inside."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import ClassVar, Self, TypeGuard

from ethbrake_marl.agents.knowledge import Knowledge, Source, combined
from ethbrake_marl.agents.protocol import Agent, Divisible, LookingAhead
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Ints, Worlds


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
        return combined(self.policy, also=self.adds)

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
        self.policy.begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """As the policy, [n] m/s2."""
        return self.policy.act(worlds, vehicle)

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
