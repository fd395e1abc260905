"""Settings for functions that make agents, and the signatures of such functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.scenario.schema import Scenario

HORIZON_S = 8.0  # horizon of agents that look ahead, if there is no scenario


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Settings for a function that makes an agent, in addition to the argument in the agent's specification.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.AgentSettings("constant:3.5", scenario=eb.load_scenario("paper-random")).needed_scenario().name
    'paper-random'

    """

    spec: str  # specification of the agent, such as "constant:3.5", with the wrappers that were already made
    policy: str | None = None  # text after the @ of the specification; None without an @
    scenario: Scenario | None = None  # scenario in which the agent drives; None: unknown
    harm_count: HarmCount = "first"  # impacts whose harm an optimising agent minimises: each pair's first, or all
    horizon_s: float = HORIZON_S  # time after the alert until which an agent looks ahead (s)
    most_candidates: int | None = None  # upper limit for the candidates of a search; None: no limit
    uncertainty: object = None  # uncertainty of the worlds, in the format of the shield that considers it; None: none
    time_step_s: float = 0.1  # time between two decisions (s)
    role: int | None = None  # index of the vehicle whose role this agent is in the scenario; None: not a role

    def needed_scenario(self) -> Scenario:
        """Return ``scenario``; raise ``InvalidInput`` if it is None."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario, for instance make_agent({self.spec!r},"
                " scenario='paper-random')"
            )
        return self.scenario


Factory = Callable[[str | None, AgentSettings], Driver]
"""Function ``(argument, settings)`` that makes an agent; ``argument`` is the text after the colon, or None."""

Wrapper = Callable[[Any, str | None, AgentSettings], Driver]
"""Function ``(agent or team, argument, settings)`` that makes a shield or a search around the agent or team."""


class Variant(NamedTuple):
    """Variant of an agent or shield. In a specification the variant is the last word, as in ``step:estimated``."""

    make: Factory | Wrapper  # function that makes the agent or wrapper, in place of the original function
    about: str  # description in one line
