"""A driver behind a shield, for evaluations: it proposes, and a guard in the engine decides."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from ethbrake_marl.agents.protocol import Agent, ByPolicy, Driver, Knowledge, Source, Team, check_agent
from ethbrake_marl.engine.engine import Engine, Guard
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.checks import check_scenario
from ethbrake_marl.shield.options import ShieldOptions
from ethbrake_marl.shield.paper_hybrid import HybridAgent


class ShieldedDriver(ByPolicy):
    """An agent, or a team, behind a shield that certifies every action: mode ``step``, or one of an extension.

    Where an agent, rolled out at the alert, harms no more than the coupled optimum, it drives unhindered, and its harm
    is the bound. Elsewhere each action must be certified: by the rest of the plan, by a constant, or by the policy,
    rolled out from the state after the action. All proposals of a team are known before any action is applied.

    Args:
        policy: proposes.
        scenario: in which actions are certified.
        later_rollouts: whether the policy itself may certify an action.
        told: worlds at the alert as the shield takes them to be; None: as they are, which the policy sees.
        options: keywords of ``ShieldOptions``.

    Raises ``InvalidInput`` for what is no agent and what does not fit, and for a learner that a team does not drive.

    >>> import ethbrake_marl as eb
    >>> eb.make_agent("coast+step", scenario=eb.load_scenario("paper-random")).on([1]).name
    'coast+step'

    """

    def __init__(
        self,
        policy: Driver,
        scenario: Scenario,
        *,
        later_rollouts: bool = True,
        told: Worlds | None = None,
        **options: Any,
    ) -> None:
        self.options = ShieldOptions(**options)
        if self.options.mode == "episode":
            raise InvalidInput("shield: mode = 'episode': HybridAgent is that of mode episode")
        check_agent(policy, str(self.options.mode), alone=not isinstance(policy, Team))
        check_scenario(scenario, str(self.options.mode))
        if not (told is None or isinstance(told, Worlds)):
            raise InvalidInput(f"step: told = {told!r}: must be worlds at the alert, or None")
        if isinstance(policy, Team) and (
            undriven := [scenario.vehicle_names[i] for i in scenario.learners if i not in policy.drivers]
        ):
            raise InvalidInput(
                f"team {policy.name!r}: does not drive {', '.join(undriven)}; beside a shielded vehicle every other one"
                " is shielded too, or follows a script"
            )
        self.policy, self.scenario = policy, scenario
        self._how = {"later_rollouts": later_rollouts, "told": told}
        self.name = f"{policy.name}+{self.options.written}"
        self.options.check_in(scenario, several=isinstance(policy, Team))

    @property
    def adds(self) -> Source:
        """What the shield knows of the line, in which it certifies, beside what the policy knows."""
        return self.options.adds

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and what the shield adds."""
        return Knowledge.of(self.policy, also=self.adds)

    @classmethod
    def around(cls, driver: Driver, task: Task, **settings: Any) -> Team:
        """A copy of the ``driver`` behind one shield, on the task's vehicles; settings as of the class."""
        if isinstance(driver, Team) and len(task.vehicles) == 1:
            driver = Team.of(driver, task.vehicles).drivers[task.vehicle]
        elif isinstance(driver, Agent) and len(task.vehicles) > 1:
            driver = Team.of(driver, task.vehicles)
        return cls(driver, task.scenario, harm_count=task.harm_count, **settings).on(task.vehicles)

    def on(self, vehicles: Collection[int]) -> Team:
        """The team that drives these vehicles behind one shield, each by its own copy."""
        return Team(Team.of(self.policy, vehicles).drivers, self.name, shield=self)

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """The guard for the engine in which they drive."""
        return self.options.guard(engine, policies, several=isinstance(self.policy, Team), **self._how)


def shielded(driver: Driver, scenario: Scenario, mode: str, **options: Any) -> Driver:
    """An agent or a team behind a shield; an agent whose scenario has several learners drives each by a copy."""
    if mode == "episode":
        settings = ShieldOptions(mode, **options)
        return HybridAgent(driver, scenario, bound=settings.bound, harm_count=settings.harm_count)  # type: ignore[arg-type]  # which refuses a team
    if isinstance(driver, Agent) and len(scenario.learners) > 1:
        driver = Team.of(driver, scenario.learners)
    around = ShieldedDriver(driver, scenario, mode=mode, **options)
    return around.on(driver.drivers) if isinstance(driver, Team) else around
