"""A team behind one step shield: every proposal is known before any action is applied."""

from __future__ import annotations

import copy
from typing import Any

from ethbrake_marl.agents.protocol import Agent, AgentAround
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.rows import Packed
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.agents import StepShieldAgent
from ethbrake_marl.shield.step_shield import StepShield


class ShieldedTeam(Team):
    """Every driver of a ``team`` proposes, and one ``StepShield`` certifies or replaces what they do together.

    The settings are those of ``StepShieldAgent``. After ``begin``, ``predicted_harm`` [n] is the bound.
    Raises ``InvalidInput`` for a learner of the scenario that the team does not drive, and what ``StepShield`` raises.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("cooperation-3-pair")
    >>> team = eb.make_agent("full_brake+step", scenario=scenario)
    >>> sorted(team.drivers), team.name
    ([1, 2], 'full_brake+step')

    """

    def __init__(self, team: Team, scenario: Scenario, **settings: Any) -> None:
        if undriven := [scenario.vehicle_names[i] for i in scenario.learners if i not in team.drivers]:
            raise InvalidInput(
                f"team {team.name!r}: does not drive {', '.join(undriven)}; beside a shielded vehicle every other one"
                " is shielded too, or follows a script"
            )
        self.together = _Together(copy.deepcopy(team), scenario, settings)
        super().__init__({i: _Member(self.together, i) for i in team.drivers}, f"{team.name}+step")

    @property
    def policy(self) -> Team:
        """Who proposes: the team as it is without a shield."""
        return Team(self.together.policies, self.name.removesuffix("+step"))

    @property
    def shield(self) -> StepShield | None:
        """The shield as it is now; None before an episode began."""
        return self.together.shield

    @property
    def predicted_harm(self) -> Floats:
        """The bound at the alert, [n] m2/s2."""
        return self.together.predicted_harm

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        return self.together.chosen_policy


class _Together(StepShieldAgent):
    """The shield of a team, and who proposes; what the first member is told, or asks, is done for all."""

    def __init__(self, team: Team, scenario: Scenario, settings: dict[str, Any]) -> None:
        self.policies = team.drivers
        self.vehicles = tuple(team.drivers)  # front to rear
        self._told: set[int] = set()  # members that know of the episodes that began last
        super().__init__(team.drivers[self.vehicles[0]], scenario, **settings)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Find the bound once for all members."""
        if not self._told or vehicle in self._told:
            self._told = set()
            self.begin_all(worlds, self.vehicles, self.policies, rows)
        self._told.add(vehicle)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command of one member, [n] m/s2; all are decided when the first one asks."""
        return self.act_all(worlds, self.vehicles, self.policies)[:, self.vehicles.index(vehicle)].copy()


class _Member(AgentAround):
    """One driver of a shielded team."""

    adds = StepShieldAgent.adds

    def __init__(self, together: _Together, vehicle: int) -> None:
        policy = together.policies[vehicle]
        super().__init__(policy, f"{policy.name}+step")
        self.together = together

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """As all of them."""
        self.together.begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Its own command, [n] m/s2."""
        return self.together.act(worlds, vehicle)

    def after_step(self, packed: Packed) -> None:
        """Follow the engine; the first member that is told does it for all."""
        self.together.after_step(packed)


def shield_around(agent: Agent) -> StepShield | None:
    """The step shield of an agent, or of the shielded team that it is a member of; None where there is none yet."""
    if isinstance(agent, _Member):
        return agent.together.shield
    return agent.shield if isinstance(agent, StepShieldAgent) else None


def drives_alone(driver: Driver) -> Agent | ShieldedTeam | None:
    """Who may say something about a whole world: an agent, the only driver of a team, or a shielded team."""
    if isinstance(driver, ShieldedTeam) or not isinstance(driver, Team):
        return driver
    return next(iter(driver.drivers.values())) if len(driver.drivers) == 1 else None
