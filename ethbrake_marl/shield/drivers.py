"""Drivers behind a shield, in evaluations: what they did, and what the shield did to them, world by world."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.driving import Episodes, drive
from ethbrake_marl.agents.protocol import Agent, ByPolicy, Driver, Knowledge, Source, Team, check_agent
from ethbrake_marl.engine.engine import Engine, Guard
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.extensions.certified.enclosure import CORNERS
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.checks import check_scenario
from ethbrake_marl.shield.options import BelievedGuard, ShieldOptions, StepGuard
from ethbrake_marl.shield.paper_hybrid import HybridAgent
from ethbrake_marl.shield.step import StepShield


class ShieldedDriver(ByPolicy):
    """An agent, or a team, behind a shield in mode ``step`` or ``robust``: it proposes, a guard in the engine decides.

    Where an agent harms no more than the coupled optimum, rolled out at the alert, it drives unhindered, and its harm
    is the bound. Elsewhere each action must be certified: by the rest of the plan, by a constant, or by the policy,
    rolled out from the state after the action. Of a team all proposals are known before any is applied.

    Args:
        policy: who proposes.
        scenario: in which actions are certified.
        later_rollouts: whether the policy itself may certify an action.
        told: worlds at the alert as the shield takes them to be; None: as they are, which is what the policy sees.
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
        self._guard: dict[str, Any] = {} if self.options.believed else {"later_rollouts": later_rollouts, "told": told}
        robust = "" if self.options.robust == CORNERS else f":{self.options.robust}"
        self.name = f"{policy.name}+{self.options.mode}{robust}{':believed' if self.options.believed else ''}"
        one = scenario.learners[0] if len(scenario.learners) == 1 else None
        if self.options.believed:  # refuses bad settings at once; without one learner nobody knows whose scripts count
            self.options.believed_shield(scenario, one or 0, {} if one is None else None)
        elif not isinstance(policy, Team):
            self.options.step_shield(scenario, one or 0)

    @property
    def adds(self) -> Source:
        """What it knows beside what the policy knows: that in which actions are certified."""
        return Source.BELIEFS if self.options.believed else Source.MODEL

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
        """What stands in the engine in which they drive."""
        if self.options.believed:
            return BelievedGuard(engine, policies, self.options)
        return StepGuard(engine, policies, self.options, several=isinstance(self.policy, Team), **self._guard)


CHUNK = 500  # worlds advanced together: bounds memory, changes no result


class Shielded(NamedTuple):
    """Episodes behind a step shield: n worlds (any axes before), N vehicles, K of them shielded."""

    harm: Floats  # [n] of the count that is guarded (m2/s2)
    vehicle_harm: Floats  # [n, N] what each vehicle bears of it
    bound: Floats  # [n] that was told at the alert, with the allowance
    baseline: Floats  # [n, N] what each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] decisions of each shielded vehicle that were replaced
    decisions: Ints  # [n] of each of them
    moving: Bools  # [n] the horizon cut the episode off

    @staticmethod
    def of(episodes: Episodes, task: Task) -> Shielded:
        """What a step shield did in these episodes."""
        shield: StepShield = episodes.guarded.shield
        assert shield.running is not None
        return Shielded(
            episodes.ledger.world_harm(task.harm_count),
            episodes.ledger.vehicle_harm(task.harm_count),
            shield.predicted_harm,
            shield.baseline_shares,
            shield.replaced.reshape(len(shield.replaced), -1),
            shield.running.steps.copy(),
            ~episodes.at_rest,
        )

    @staticmethod
    def driven(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
        """A copy of the ``driver`` drives every world behind a step shield, ``CHUNK`` at a time; as ``around``."""
        parts = []
        for first in range(0, worlds.n, CHUNK):
            rows = np.arange(first, min(first + CHUNK, worlds.n))
            with renumbered(rows):
                episodes = drive(worlds.take(rows), ShieldedDriver.around(driver, task, **settings), task.scenario)
            parts.append(Shielded.of(episodes, task))
        return Shielded.join(parts)

    @staticmethod
    def join(parts: Sequence[Shielded]) -> Shielded:
        """Consecutive worlds as one."""
        return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @staticmethod
    def stack(parts: Sequence[Shielded]) -> Shielded:
        """Several drivers in the same worlds, on an axis in front."""
        return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def shielded(driver: Driver, scenario: Scenario, mode: str, **options: Any) -> Driver:
    """An agent or a team behind a shield; an agent whose scenario has several learners drives each by a copy."""
    if mode == "episode":
        settings = ShieldOptions(mode, **options)
        return HybridAgent(driver, scenario, bound=settings.bound, harm_count=settings.harm_count)  # type: ignore[arg-type]  # which refuses a team
    if isinstance(driver, Agent) and len(scenario.learners) > 1:
        driver = Team.of(driver, scenario.learners)
    around = ShieldedDriver(driver, scenario, mode=mode, **options)
    return around.on(driver.drivers) if isinstance(driver, Team) else around
