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
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.errors import InvalidInput, count_of, renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.physics.episode import decision_at, first_decision_s
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.behind import Behind, drive_behind, put_shield, shield_of
from ethbrake_marl.shield.rollouts import proposed_action

SAME_HARM = 1e-9  # harms (m2/s2) closer than this are one harm
ALLOWANCES = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 1e6)  # m2/s2, of an operating curve
VERDICTS = ("needed", "harmless", "costly")


class Review(NamedTuple):
    """What each logged intervention of the running episodes was good for; m interventions."""

    world: Ints  # [m] row of the batch
    vehicle: Ints  # [m] whose action was replaced
    step: Ints  # [m] number of the decision
    realised: Floats  # [m] harm of the episode as it went (m2/s2)
    without: Floats  # [m] had the policy, or the whole team, driven alone from that decision on
    verdict: NDArray[np.str_]  # [m] one of VERDICTS
    trusted: Bools  # [m] nothing seen in that world contradicted the assumptions

    def share(self, verdict: str) -> float:
        """Share of the interventions with this verdict; 0 where there was none."""
        return float((self.verdict == verdict).mean()) if self.verdict.size else 0.0


def review(driver: Behind, worlds: Worlds, vehicle: int | None = None) -> Review:
    """Simulate every intervention of a driven batch again without it: from there on the policy drives alone.

    Of a ``ShieldedTeam`` the whole team does; ``vehicle`` is then None. ``worlds`` are those that ``driver`` (made with
    ``logging=True``) was driven through last, at the alert; what was logged in earlier episodes is left out. *needed*:
    harm would have been higher; *costly*: lower; *harmless*: the same. What was realised is simulated again, too, so
    both harms are the engine's, also where the truth was not what the shield was told. Raises ``InvalidInput`` without
    a log, or for another number of worlds.
    """
    shield = driver.shield
    if shield is None or shield.log is None or shield.running is None:
        raise InvalidInput("review: nothing was logged; make the agent with logging=True, and drive it")
    if worlds.n != shield.running.n:
        raise InvalidInput(f"review: {count_of(worlds.n, 'world')}, but {shield.running.n} were driven last")
    log = [entry for entry in shield.log if entry.world < worlds.n and entry.episode == shield.episode[entry.world]]
    released = _Release(driver, worlds, vehicle)
    world = np.array([entry.world for entry in log], np.int64)
    step = np.array([entry.step for entry in log], np.int64)
    realised, without = np.zeros(0), np.zeros(0)
    if world.size:
        every, plan = np.arange(worlds.n), shield.backup.plan
        never = np.full(worlds.n, plan.shape[1])
        realised = released.harm(every, never)[world]
        without = released.harm(world, step)
    verdict = np.where(without > realised + SAME_HARM, "needed", "harmless")
    verdict = np.where(without < realised - SAME_HARM, "costly", verdict)
    whose = np.array([entry.vehicle for entry in log], np.int64)
    return Review(world, whose, step, realised, without, verdict, ~shield.distrusted[world])


class _Release(NamedTuple):
    """Who drove a batch behind a shield, and its worlds at the alert."""

    driver: Behind
    worlds: Worlds
    vehicle: int | None  # None: a team drove

    def harm(self, world: Ints, step: Ints) -> Floats:
        """In some worlds [m], when what was applied is applied again up to decision ``step`` [m], then who proposes."""
        shield, policy = shield_of(self.driver), self.driver.policy
        vehicles, scenario = shield.vehicles, shield.scenario
        plan = shield.backup.plan[world]
        actions = plan.reshape(*plan.shape[:2], len(vehicles))
        proposing = policy.drivers if isinstance(policy, Team) else {vehicles[0]: policy}
        again = {
            i: _Released(copy.deepcopy(proposing[i]), actions[:, :, c], step, vehicles, scenario.time_step_s)
            for c, i in enumerate(vehicles)
        }
        driver = Team(again, "released") if self.vehicle is None else again[self.vehicle]
        with renumbered(world):
            return drive(self.worlds.take(world), driver, scenario, self.vehicle).ledger.world_harm(shield.harm_count)


class OperatingPoint(NamedTuple):
    """What the shield does at one allowance."""

    allowance: float  # m2/s2 above the bound that certificates may reach
    intervention_rate: float  # share of decisions, of all shielded vehicles together
    harm: float  # mean over worlds (m2/s2)
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no point, whichever allowance met them


def operating_curves(
    worlds: Worlds,
    policies: Mapping[str, Driver],
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


def _operating_points(worlds: Worlds, policy: Driver, task: Task, allowances: Sequence[float]) -> list[OperatingPoint]:
    points = []
    for allowance in allowances:
        found = drive_behind(put_shield(policy, task, allowance=allowance), worlds, task)
        rate = float(found.replaced.sum() / (found.decisions.sum() * found.replaced.shape[1]))
        points.append(OperatingPoint(float(allowance), rate, float(found.harm.mean())))
    return points


class _Released(AgentAround):
    """Given actions [m, L] up to a step, and from that step on a policy."""

    def __init__(
        self, policy: Agent, actions: Floats, release: Ints, deciding: tuple[int, ...], time_step_s: float
    ) -> None:
        super().__init__(policy, "released")
        self._actions, self._release, self._time_step_s = actions, release, time_step_s
        self._deciding = deciding  # vehicles that decide together
        self._first_s: Floats = np.zeros(0)  # [m] time of the first decision

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        super().begin(worlds, vehicle, rows)
        self._first_s = first_decision_s(worlds, self._deciding)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        own = proposed_action(self.policy, worlds, vehicle)
        step = decision_at(worlds.time_s, self._first_s, self._time_step_s)
        held = self._actions[np.arange(len(step)), np.clip(step, 0, self._actions.shape[1] - 1)]
        action = np.where(step < self._release, held, own)
        return action_to_command(action, worlds.vehicles, vehicle)
