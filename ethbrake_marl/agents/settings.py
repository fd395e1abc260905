"""Settings for making an agent, and the signatures of the functions that make one."""

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

    spec: str  # specification of the agent, such as "planner:64", with the wrappers made so far
    policy: str | None = None  # text after the @ of the specification; None without one
    scenario: Scenario | None = None  # scenario in which the agent drives; None: unknown
    harm_count: HarmCount = "first"  # impacts whose harm an optimising agent minimises: each pair's first, or all
    horizon_s: float = HORIZON_S  # time after the alert until which an agent looks ahead (s)
    most_candidates: int | None = None  # upper limit for the candidates of a search; None: no limit
    uncertainty: object = None  # what a shield does not know about the worlds, in that shield's format; None: nothing
    time_step_s: float = 0.1  # time between two decisions (s)
    role: int | None = None  # index of the vehicle for which the scenario names this agent; None: not from a scenario

    def needed_scenario(self) -> Scenario:
        """Return ``scenario``; raise ``InvalidInput`` if it is None."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario: make_agent({self.spec!r}, scenario='paper-random')"
            )
        return self.scenario


# Called as (argument, settings).
Factory = Callable[[str | None, AgentSettings], Driver]
"""Makes the agent of an argument (what stands after the colon, or None)."""

# Called as (agent or team, argument, settings); makes a shield or a search around the agent.
Wrapper = Callable[[Any, str | None, AgentSettings], Driver]
"""Makes the agent around an agent."""


class Variant(NamedTuple):
    """Variant of an agent or a shield, selected by a last word: ``estimated`` in ``step:estimated``."""

    make: Factory | Wrapper  # makes the agent or wrapper in place of the original function
    about: str  # description in one line
