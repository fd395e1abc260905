"""Drivers behind a shield, in evaluations: what they did, and what the shield did to them, world by world."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.believed import Believing, split_believed
from ethbrake_marl.agents.protocol import Agent, Driver, Knowledge, Source, Team, check_agent, combine, team_of
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.rollout import Episodes, drive
from ethbrake_marl.engine.engine import Engine, Guard
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.worlds import vehicles_at_once
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.shield.enclosure import CORNERS, checked_robust
from ethbrake_marl.shield.guard import BelievedGuard, Bound, HybridAgent, ShieldOptions, StepGuard
from ethbrake_marl.shield.step_shield import StepShield
from ethbrake_marl.shield.uncertainty import check_scenario, mode_uncertainty


class ShieldedDriver:
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
        if not isinstance(policy, Team):
            check_agent(policy, str(self.options.mode))
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
        if self.options.believed:
            self.options.believed_shield(scenario)  # refuses bad settings at once
        elif not isinstance(policy, Team):
            self.options.step_shield(scenario, scenario.learners[0] if len(scenario.learners) == 1 else 0)

    @property
    def adds(self) -> Source:
        """What it knows beside what the policy knows: that in which actions are certified."""
        return Source.BELIEFS if self.options.believed else Source.MODEL

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and what the shield adds."""
        return combine(self.policy, also=self.adds)

    def on(self, vehicles: Collection[int]) -> Team:
        """The team that drives these vehicles behind one shield, each by its own copy."""
        return Team(team_of(self.policy, vehicles).drivers, self.name, shield=self)

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


def put_shield(driver: Driver, task: Task, **settings: Any) -> Team:
    """A copy of the ``driver`` behind one step shield, on the task's vehicles; settings as of ``ShieldedDriver``."""
    if isinstance(driver, Team) and len(task.vehicles) == 1:
        driver = team_of(driver, task.vehicles).drivers[task.vehicle]
    elif isinstance(driver, Agent) and len(task.vehicles) > 1:
        driver = Team.copies(driver, task.vehicles)
    return ShieldedDriver(driver, task.scenario, harm_count=task.harm_count, **settings).on(task.vehicles)


def shielded_episodes(episodes: Episodes, task: Task) -> Shielded:
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


def drive_chunks(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
    """Let a copy of the ``driver`` drive every world behind a step shield, ``CHUNK`` at a time; as ``put_shield``."""
    parts = []
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with renumbered(rows):
            episodes = drive(worlds.take(rows), put_shield(driver, task, **settings), task.scenario)
        parts.append(shielded_episodes(episodes, task))
    return join(parts)


def join(parts: Sequence[Shielded]) -> Shielded:
    """Consecutive worlds as one."""
    return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def stack(parts: Sequence[Shielded]) -> Shielded:
    """Several drivers in the same worlds, on an axis in front."""
    return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


# Factories of what the registry puts around an agent: the shields, with and without ``:believed``.


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return combine(self.policy.policy, also=Source.BELIEFS)

    def _begin_policy(self, believed: Worlds, vehicle: int, rows: Ints) -> None:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = vehicles_at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution
        )
        line = replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip
        super()._begin_policy(line, vehicle, rows)


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent, with ``:believed`` behind on what was received."""
    pairwise, believes = split_believed(argument)
    bound: Bound = "coupled" if pairwise is None else "pairwise"
    scenario = settings.needed_scenario()
    hybrid = HybridAgent(policy, scenario, bound=bound, harm_count=settings.harm_count)
    if believes and isinstance(policy, Believing):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return BelievingHybrid(hybrid, scenario) if believes else hybrid


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent or a team, where several vehicles learn around a copy for each; ``+step:believed``."""
    scenario, believes = settings.needed_scenario(), split_believed(argument)[1]
    several = isinstance(policy, Team) or len(scenario.learners) > 1
    if several and believes:
        raise InvalidInput(f"agent {settings.spec!r}: :believed shields one learner, not several; take +step")
    if several and isinstance(policy, Agent):
        policy = Team.copies(policy, scenario.learners)
    shielded = ShieldedDriver(policy, scenario, mode="step", harm_count=settings.harm_count, believed=believes)
    return shielded.on(policy.drivers) if isinstance(policy, Team) else shielded


def shield_steps_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """``+robust`` or ``+robust:interior``, against the uncertainty of the settings.

    With ``:believed`` behind, against all that was not received, without one.
    """
    scenario, where, (certainty, believes) = (
        settings.needed_scenario(), f"agent {settings.spec!r}", split_believed(argument),
    )  # fmt: skip
    return ShieldedDriver(
        policy, scenario, mode="robust", harm_count=settings.harm_count, believed=believes, where=where,
        robust=checked_robust(certainty or CORNERS, where),
        uncertainty=None if believes else mode_uncertainty("robust", settings.uncertainty, where),
    )  # fmt: skip
