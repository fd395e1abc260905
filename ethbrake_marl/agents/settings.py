"""``AgentSettings``: what the function that makes an agent is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.scenario.schema import Scenario

HORIZON_S = 8.0  # horizon of agents that look ahead, if there is no scenario


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Settings for making an agent, beyond its own argument.

    >>> import ethbrake_marl as eb
    >>> eb.AgentSettings("planner:64", scenario=eb.load_scenario("paper-random")).needed_scenario().name
    'paper-random'

    """

    spec: str  # the specification, with the wrappers so far
    policy: str | None = None  # text after the @
    scenario: Scenario | None = None  # scenario of the agent, if known
    harm_count: HarmCount = "first"  # harm that an optimising agent minimises
    horizon_s: float = HORIZON_S  # time until which it looks ahead (s)
    most_candidates: int | None = None  # upper limit for a search, stricter than its argument; None: no limit
    uncertainty: object = None  # what a shield does not know about the worlds, in that shield's format
    time_step_s: float = 0.1  # time between two decisions
    role: int | None = None  # index of the vehicle, if the agent is its role in the scenario; otherwise None

    def needed_scenario(self) -> Scenario:
        """Return the scenario; raise ``InvalidInput`` if there is none."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario: make_agent({self.spec!r}, scenario='paper-random')"
            )
        return self.scenario


Factory = Callable[[str | None, AgentSettings], Driver]
"""Makes the agent of an argument (what stands after the colon, or None)."""

Wrapper = Callable[[Any, str | None, AgentSettings], Driver]
"""Makes the agent around an agent."""


class Variant(NamedTuple):
    """A variant of an agent or a shield, selected by a word after its argument."""

    make: Factory | Wrapper
    about: str  # description in one line
