"""Agents and teams behind a shield, for evaluations: the agent proposes actions, a guard in the engine decides."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.protocol import Agent, ByPolicy, Driver, Knowledge, Source, Team, check_agent
from ethbrake_marl.first_edition.engine.engine import Engine, Guard
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.checks import check_scenario
from ethbrake_marl.first_edition.shields.options import ShieldOptions
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent


class ShieldedDriver(ByPolicy):
    """An agent or a team behind a shield that certifies every action: mode ``step``, or a mode of an extension.

    At the alert the policy is simulated to the end of the episode. In worlds where the simulated policy does at most
    the harm of E-V2X-BM, the policy drives without interventions, and the policy's harm is the bound. In all other
    worlds each proposed action must be certified by a plan that begins with this action, and continues with the rest of
    the present plan, with a constant action, or with a rollout (a simulation of the policy). In each world, the shield
    decides on the proposals of all vehicles of a team together.

    Args:
        policy: the agent or team that proposes actions.
        scenario: the scenario in which actions are certified.
        later_rollouts: whether a rollout of the policy that starts after the alert may certify an action.
        assumed: the worlds at the alert, as the shield assumes them; None: the shield knows the true worlds. The policy
            always observes the true worlds.
        options: keywords of ``ShieldOptions``.

    Raises ``InvalidInput`` if ``policy`` is not an agent or team, for invalid options, and if a team does not drive
    every learner.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.make_agent("coast+step", scenario=eb.load_scenario("paper-random")).on([1]).name
    'coast+step'

    """

    def __init__(
        self,
        policy: Driver,
        scenario: Scenario,
        *,
        later_rollouts: bool = True,
        assumed: Worlds | None = None,
        **options: Any,
    ) -> None:
        self.options = ShieldOptions(**options)
        if self.options.mode == "episode":
            raise InvalidInput(
                "shield: mode = 'episode': is not possible with ShieldedDriver; use HybridAgent for this mode"
            )
        check_agent(policy, str(self.options.mode), alone=not isinstance(policy, Team))
        check_scenario(scenario, str(self.options.mode))
        if not (assumed is None or isinstance(assumed, Worlds)):
            raise InvalidInput(
                f"step: assumed = {assumed!r}: must be None or a Worlds object (the worlds at the alert)"
            )
        if isinstance(policy, Team) and (
            undriven := [scenario.vehicle_names[i] for i in scenario.learners if i not in policy.drivers]
        ):
            raise InvalidInput(
                f"team {policy.name!r}: does not drive {', '.join(undriven)}; behind a shield, a team must drive every"
                " learner of the scenario"
            )
        self.policy, self.scenario = policy, scenario
        self._how = {"later_rollouts": later_rollouts, "assumed": assumed}
        self.name = f"{policy.name}+{self.options.written}"
        self.options.check_in(scenario, several=isinstance(policy, Team))

    @property
    def adds(self) -> Source:
        """Knowledge that the shield uses to certify actions, beyond what the policy knows."""
        return self.options.adds

    @property
    def knows(self) -> Knowledge:
        """Knowledge of the policy and the shield together."""
        return Knowledge.of(self.policy, also=self.adds)

    @classmethod
    def around(cls, driver: Driver, task: Task, **settings: Any) -> Team:
        """Return a team in which copies of ``driver``, behind one shield, drive the controlled vehicles of ``task``.

        The scenario and the harm count come from ``task``; ``settings`` are further keywords of ``ShieldedDriver``.
        """
        if isinstance(driver, Team) and len(task.vehicles) == 1:
            driver = Team.of(driver, task.vehicles).drivers[task.vehicle]
        elif isinstance(driver, Agent) and len(task.vehicles) > 1:
            driver = Team.of(driver, task.vehicles)
        return cls(driver, task.scenario, harm_count=task.harm_count, **settings).on(task.vehicles)

    def on(self, vehicles: Collection[int]) -> Team:
        """Return a team behind one shield, in which a copy of the policy drives each of ``vehicles`` (indices)."""
        return Team(Team.of(self.policy, vehicles).drivers, self.name, shield=self)

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """Return the guard for ``engine``; the agents in ``policies`` (vehicle index -> agent) propose actions."""
        return self.options.guard(engine, policies, several=isinstance(self.policy, Team), **self._how)


def shielded(driver: Driver, scenario: Scenario, mode: str, **options: Any) -> Driver:
    """Return the agent or team ``driver`` with a shield that certifies actions in ``scenario``.

    If the scenario has several learners, a copy of the agent drives each of them. ``mode`` is ``step``, ``episode`` or
    a mode of an extension; ``options`` are further keywords of ``ShieldOptions``.
    """
    if mode == "episode":
        settings = ShieldOptions(mode, **options)
        return HybridAgent(driver, scenario, bound=settings.bound, harm_count=settings.harm_count)  # type: ignore[arg-type]  # which refuses a team
    if isinstance(driver, Agent) and len(scenario.learners) > 1:
        driver = Team.of(driver, scenario.learners)
    around = ShieldedDriver(driver, scenario, mode=mode, **options)
    return around.on(driver.drivers) if isinstance(driver, Team) else around
