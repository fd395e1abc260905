"""Was an intervention needed? Every one is simulated again without it, and the price of the bound is measured."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command
from ethbrake_marl.agents.protocol import Agent, AgentAround
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.errors import InvalidInput, count_of, renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.physics.episode import decision_at, first_decision_s
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.agents import StepShieldAgent
from ethbrake_marl.shield.rollouts import proposed_action

SAME_HARM = 1e-9  # harms (m2/s2) closer than this are one harm
ALLOWANCES = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 1e6)  # m2/s2, of an operating curve
VERDICTS = ("needed", "harmless", "costly")


class Review(NamedTuple):
    """What each logged intervention of the running episodes was good for; m interventions."""

    world: Ints  # [m] row of the batch
    step: Ints  # [m] number of the decision
    realised: Floats  # [m] harm of the episode as it went (m2/s2)
    without: Floats  # [m] had the policy driven alone from that decision on
    verdict: NDArray[np.str_]  # [m] one of VERDICTS
    trusted: Bools  # [m] nothing seen in that world contradicted the assumptions

    def share(self, verdict: str) -> float:
        """Share of the interventions with this verdict; 0 where there was none."""
        return float((self.verdict == verdict).mean()) if self.verdict.size else 0.0


def review(driver: StepShieldAgent, worlds: Worlds, vehicle: int) -> Review:
    """Simulate every intervention of a driven batch again without it: from there on the policy drives alone.

    ``worlds`` are those that ``driver`` (made with ``logging=True``) was driven through last, at the alert; what was
    logged in earlier episodes is left out. *needed*: harm would have been higher; *costly*: lower; *harmless*: the
    same. What was realised is simulated again, too, so both harms are the engine's, also where the truth was not what
    the shield was told. Raises ``InvalidInput`` without a log, or for another number of worlds.
    """
    shield = driver.shield
    if shield is None or shield.log is None or shield.running is None:
        raise InvalidInput("review: nothing was logged; make the agent with logging=True, and drive it")
    if worlds.n != shield.running.n:
        raise InvalidInput(f"review: {count_of(worlds.n, 'world')}, but {shield.running.n} were driven last")
    log = [entry for entry in shield.log if entry.world < worlds.n and entry.episode == shield.episode[entry.world]]
    world = np.array([entry.world for entry in log], np.int64)
    step = np.array([entry.step for entry in log], np.int64)
    realised, without = np.zeros(0), np.zeros(0)
    if world.size:
        every, plan = np.arange(worlds.n), shield.backup.plan
        never = np.full(worlds.n, plan.shape[1])
        realised = _harm_released(driver, worlds, vehicle, every, never)[world]
        without = _harm_released(driver, worlds, vehicle, world, step)
    verdict = np.where(without > realised + SAME_HARM, "needed", "harmless")
    verdict = np.where(without < realised - SAME_HARM, "costly", verdict)
    return Review(world, step, realised, without, verdict, ~shield.distrusted[world])


def _harm_released(driver: StepShieldAgent, worlds: Worlds, vehicle: int, world: Ints, step: Ints) -> Floats:
    """Harm in some worlds [m] when what was applied is applied again up to decision ``step`` [m], then the policy."""
    assert driver.shield is not None
    again = _Released(copy.deepcopy(driver.policy), driver.shield.backup.plan[world], step, driver.scenario.time_step_s)
    with renumbered(world):
        return drive(worlds.take(world), again, driver.scenario, vehicle).ledger.world_harm(driver.shield.harm_count)


class OperatingPoint(NamedTuple):
    """What the shield does at one allowance."""

    allowance: float  # m2/s2 above the bound that certificates may reach
    intervention_rate: float  # share of decisions
    intervened_worlds: float  # share of worlds with at least one
    harm: float  # mean over worlds (m2/s2)
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no point, whichever allowance met them


def operating_curves(
    worlds: Worlds,
    policies: Mapping[str, Agent],
    task: Task,
    allowances: Sequence[float],
    *,
    on_progress: Callable[[str], None] | None = None,
) -> dict[str, list[OperatingPoint]]:
    """Interventions against residual harm for each policy: one point per allowance, from none to very large.

    A world that cannot be advanced in one of the cases is left out of all, and named in ``left_out``; ``on_progress``
    is told each policy that is done. Raises ``PhysicsError`` where no world is left.
    """

    def measured(at: Ints) -> dict[str, list[OperatingPoint]]:
        curves = {}
        for name, policy in policies.items():
            curves[name] = _operating_points(worlds.take(at), policy, task, allowances)
            if on_progress is not None:
                on_progress(name)
        return curves

    curves, _, left_out = measured_without_failed(measured, worlds.n)
    return {name: [point._replace(left_out=left_out) for point in points] for name, points in curves.items()}


def _operating_points(worlds: Worlds, policy: Agent, task: Task, allowances: Sequence[float]) -> list[OperatingPoint]:
    points, scenario, harm_count = [], task.scenario, task.harm_count
    for allowance in allowances:
        driver = StepShieldAgent(copy.deepcopy(policy), scenario, harm_count=harm_count, allowance=allowance)
        harm = drive(worlds, driver, scenario, task.vehicle).ledger.world_harm(harm_count)
        shield = driver.shield
        assert shield is not None and shield.running is not None
        decisions = int(shield.running.steps.sum())
        rate = float(shield.interventions.sum()) / decisions
        worlds_share = float((shield.interventions > 0).mean())
        points.append(OperatingPoint(float(allowance), rate, worlds_share, float(harm.mean())))
    return points


class _Released(AgentAround):
    """Given actions [m, L] up to a step, and from that step on a policy."""

    def __init__(self, policy: Agent, actions: Floats, release: Ints, time_step_s: float) -> None:
        super().__init__(policy, "released")
        self._actions, self._release, self._time_step_s = actions, release, time_step_s
        self._first_s: Floats = np.zeros(0)  # [m] time of the first decision

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        super().begin(worlds, vehicle, rows)
        self._first_s = first_decision_s(worlds, [vehicle])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        own = proposed_action(self.policy, worlds, vehicle)
        step = decision_at(worlds.time_s, self._first_s, self._time_step_s)
        held = self._actions[np.arange(len(step)), np.clip(step, 0, self._actions.shape[1] - 1)]
        action = np.where(step < self._release, held, own)
        return action_to_command(action, worlds.vehicles, vehicle)
