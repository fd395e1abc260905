"""Teams: one agent for each of several vehicles."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping

import numpy as np

from ethbrake_marl.agents.knowledge import Knowledge, combine
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput


class Team:
    """One agent for each driven vehicle (index, 0 = front). Each decides for its own vehicle, from what that one knows.

    One object cannot drive two vehicles, because it may remember its episodes: ``copies`` makes a team of one agent.
    Raises ``InvalidInput`` for what is not an agent, an index that is no whole number from 0, or one object twice.

    >>> import ethbrake_marl as eb
    >>> team = eb.Team({1: eb.make_agent("full_brake"), 2: eb.make_agent("copy_leader")}, "mixed")
    >>> sorted(team.drivers)
    [1, 2]

    """

    def __init__(self, drivers: Mapping[int, Agent], name: str) -> None:
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
        self.name = name

    @property
    def knows(self) -> Knowledge:
        """What its drivers know between them; nothing where nobody is driven."""
        return combine(*self.drivers.values())

    @classmethod
    def copies(cls, agent: Agent, vehicles: Collection[int]) -> Team:
        """A team in which each of ``vehicles`` is driven by its own copy of ``agent``."""
        return cls({vehicle: copy.deepcopy(agent) for vehicle in vehicles}, agent.name)


Driver = Team | Agent  # an agent alone drives every learner, each by its own copy


def team_of(driver: Driver, learners: Collection[int]) -> Team:
    """Fresh copies, one for each of the ``learners``. Raises ``InvalidInput`` for a team of other vehicles."""
    if not isinstance(driver, Team):
        return Team.copies(driver, learners)
    if set(driver.drivers) != set(learners):
        raise InvalidInput(
            f"team {driver.name!r} drives {_names(driver.drivers)}; the vehicles to drive are {_names(learners)}"
        )
    return copy.deepcopy(driver)


def _names(vehicles: Collection[int]) -> str:
    return ", ".join(f"vehicle_{i + 1}" for i in sorted(vehicles)) or "none"
