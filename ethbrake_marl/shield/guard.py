"""Step mode for a batch of running episodes: what ``certify`` decides, kept from step to step, watched and logged."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command, command_to_action
from ethbrake_marl.agents.coupled import optimise_coupled
from ethbrake_marl.agents.driving import drive, introduce, scripted
from ethbrake_marl.agents.others import fixed_commands
from ethbrake_marl.agents.profile_motion import START, TIME_STEP
from ethbrake_marl.agents.profile_problem import ProfileProblem, profile_problem
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_count
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield.certify import Backup, Decision, Running, begin_running, certify, plan_harm
from ethbrake_marl.shield.certify_kernel import ENDED
from ethbrake_marl.starts import Script

BROKEN = ENDED + 1  # the last of REASONS
Number = TypeVar("Number", bound=np.generic)
_PER_WORLD = ("start", "clock", "bounds", "command", "latency", "mass", "limit", "identity")


class Intervention(NamedTuple):
    """One decision in which something else than the proposal was applied."""

    world: int  # row of the batch
    step: int  # number of the decision
    time_s: float
    proposed: float  # action, as it was given
    applied: float  # action
    reason: int  # place in REASONS
    bound: float  # m2/s2, from now on
    margin: float  # m2/s2; negative: what the proposal would have cost beyond the budget at least
    state: Floats  # [S] at the decision
    plan: Floats  # [L] that was held


class StepShield:
    """Guarantees the harm of a batch: ``begin`` when episodes start, ``decide`` in every step.

    The bound starts as the harm of the coupled optimum, realised decision by decision, or as that of a ``policy``
    rolled out from the alert where that is lower, and only ever falls; ``allowance`` (m2/s2) is what the budget grants
    above it (0: none). The other vehicles follow ``others`` (default: the scenario's scripts), whose commands must be
    fixed at the alert. What happens is compared with what was predicted, bit by bit: where it differs (a vehicle that
    brakes beyond its capacity, a number that is none, a message that never came) ``distrusted`` [n] is set, nothing is
    guaranteed any more, and for the rest of the episode the fallback ``best constant`` drives: the better one of the
    plan's rest and the constants, chosen again after every surprise. Raises ``InvalidInput`` for an unknown count, a
    negative allowance, or others whose commands are not fixed.
    """

    fallback = "best constant"

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int,
        *,
        count: HarmCount = "first",
        allowance: float = 0.0,
        others: Mapping[int, Script] | None = None,
        logging: bool = False,
    ) -> None:
        check_count(count)
        if not 0.0 <= allowance < np.inf:
            raise InvalidInput(f"shield: allowance = {allowance!r}: must be at least 0 m2/s2")
        self.scenario, self.vehicle, self.count, self.allowance = scenario, vehicle, count, allowance
        self.log: list[Intervention] | None = [] if logging else None
        self.running: Running | None = None
        self.backup = Backup(np.zeros((0, 0)), np.zeros(0))
        self._budget: Floats = np.zeros(0)
        self.first_bound: Floats = np.zeros(0)  # [n] harm of the backup at the first decision
        self.alone_harm: Floats = np.zeros(0)  # [n] of the policy rolled out; infinity without one
        self.interventions: Ints = np.zeros(0, np.int64)  # [n] so far in the running episodes
        self.distrusted: Bools = np.zeros(0, np.bool_)
        self._others = scripted(scenario, but=vehicle) if others is None else others
        self._width = int(np.ceil(scenario.horizon_s / scenario.time_step_s)) + 1

    @property
    def bound(self) -> Floats:
        """Harm of each running episode is at most this, [n] m2/s2 (beside an ``allowance``)."""
        return self.backup.harm

    @property
    def budget(self) -> Floats:
        """What certificates may reach, [n] m2/s2."""
        return np.maximum(self.backup.harm, np.minimum(self._budget, self.first_bound + self.allowance))

    def begin(self, worlds: Worlds, rows: Ints, policy: Agent | None = None) -> None:
        """New episodes start in these rows; ``worlds`` holds those rows only, at the alert."""
        scenario, vehicle = self.scenario, self.vehicle
        others = fixed_commands(self._others, worlds, "shield", vehicle=vehicle)
        best = optimise_coupled(
            worlds, vehicle, count=self.count, horizon_s=scenario.horizon_s, others_mps2=others
        ).deceleration_mps2
        problem = profile_problem(
            worlds, [vehicle], count=self.count, horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s,
            others_mps2=others,
        )  # fmt: skip
        running = begin_running(problem)
        plan = np.repeat(command_to_action(-best, worlds.vehicles, vehicle)[:, np.newaxis], self._width, axis=1)
        harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)
        if policy is not None:
            actions = rolled_out(worlds, policy, scenario, vehicle, problem, self._width)
            alone = plan_harm(running, actions)
            plan[alone <= harm] = actions[alone <= harm]
            harm = np.minimum(alone, harm)
        self._place(rows, running, Backup(plan, harm), alone)

    def decide(self, proposed: Floats, *, seen: Floats | None = None, only: Bools | None = None) -> Decision:
        """Decide in every running episode, or ``only`` in some; the others stay as they are.

        ``seen`` [n, columns]: the worlds as they are now, in the first columns of ``Running.states``.
        """
        assert self.running is not None
        before = self.running
        asked = ~before.ended if only is None else only & ~before.ended
        if seen is not None:
            self._compare(seen, asked)
        now = self.running._replace(ended=~asked)
        given = np.where(self.distrusted, np.nan, np.asarray(proposed, np.float64))
        held, budget = self.backup, self.budget
        decision = certify(now, given, held, budget)
        decision.reason[asked & self.distrusted] = BROKEN
        self.interventions = self.interventions + (decision.intervened & asked)
        if self.log is not None:
            self._write(now, proposed, decision, held)
        self.running = decision.after._replace(ended=before.ended | (decision.after.ended & asked))
        self.backup = decision.backup
        self._budget = np.where(asked & (self.allowance == 0.0), decision.bound, self._budget)
        return decision

    def commands(self, actions: Floats) -> Floats:
        """Wanted signed accelerations of actions, to the bits of the engine, [n] m/s2."""
        assert self.running is not None
        braking, driving = -self.running.problem.bounds[:, 0, 0], self.running.problem.bounds[:, 0, 1]
        return np.where(actions < 0.0, actions * braking, actions * driving)

    def _compare(self, seen: Floats, asked: Bools) -> None:
        """Find the worlds that did not do what was predicted, and choose anew there from what is seen."""
        assert self.running is not None
        columns = seen.shape[1]
        surprising = asked & ~(seen == self.running.states[:, :columns]).all(axis=1)
        if not surprising.any():
            return
        self.distrusted = self.distrusted | surprising
        rows = np.flatnonzero(surprising & np.isfinite(seen).all(axis=1))  # others: what was predicted goes on
        states = self.running.states.copy()
        states[rows, :columns] = seen[rows]
        self.running = self.running._replace(states=states)
        plan, harm = self.backup.plan.copy(), self.backup.harm.copy()
        harm[rows] = np.inf
        for constant in (None, *self.backup.constants):
            trial = self.backup.plan if constant is None else np.full_like(plan, constant)
            found = _harm_of(self.running, trial, rows)
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        self.backup = self.backup._replace(plan=plan, harm=harm)

    def _place(self, rows: Ints, running: Running, backup: Backup, alone: Floats) -> None:
        """Keep new episodes in these rows."""
        if self.running is None or len(rows) == len(self.first_bound):
            order = np.argsort(rows)
            self.running, self.backup = _taken(running, order), Backup(backup.plan[order], backup.harm[order])
            self.first_bound, self.alone_harm = backup.harm[order], alone[order]
            self._budget = self.first_bound + self.allowance
            self.interventions, self.distrusted = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
            return
        old = self.running
        arrays: dict[str, Any] = {
            name: _put(getattr(old.problem, name), rows, getattr(running.problem, name)) for name in _PER_WORLD
        }
        self.running = Running(
            replace(old.problem, **arrays),
            _put(old.states, rows, running.states),
            _put(old.steps, rows, running.steps),
            _put(old.ended, rows, running.ended),
        )
        self.backup = Backup(_put(self.backup.plan, rows, backup.plan), _put(self.backup.harm, rows, backup.harm))
        self.first_bound = _put(self.first_bound, rows, backup.harm)
        self.alone_harm = _put(self.alone_harm, rows, alone)
        self._budget = _put(self._budget, rows, backup.harm + self.allowance)
        self.interventions = _put(self.interventions, rows, np.zeros(len(rows), np.int64))
        self.distrusted = _put(self.distrusted, rows, np.zeros(len(rows), np.bool_))

    def _write(self, now: Running, proposed: Floats, decision: Decision, held: Backup) -> None:
        assert self.log is not None
        times = now.time_s
        for k in np.flatnonzero(decision.intervened).tolist():
            row = Intervention(
                k, int(now.steps[k]), float(times[k]), float(proposed[k]), float(decision.applied[k]),
                int(decision.reason[k]), float(decision.bound[k]), float(decision.margin[k]), now.states[k].copy(),
                held.plan[k].copy(),
            )  # fmt: skip
            self.log.append(row)


def rolled_out(
    worlds: Worlds, policy: Agent, scenario: Scenario, vehicle: int, problem: ProfileProblem, width: int
) -> Floats:
    """The actions [n, width] of a policy that drives alone from the alert; full braking beyond its episode's end."""
    recorder = _Recorder(copy.deepcopy(policy), problem, width)
    introduce(recorder.policy, vehicle, scripted(scenario, but=vehicle))
    drive(worlds, recorder, scenario, vehicle)
    return recorder.actions


class _Recorder:
    """A policy whose actions are written down, and applied as they are written."""

    name = "recorder"

    def __init__(self, policy: Agent, problem: ProfileProblem, width: int) -> None:
        self.policy = policy
        self.actions = np.full((problem.n, width), -1.0)
        self._clock = problem.clock

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        self.policy.begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        action = command_to_action(self.policy.act(worlds, vehicle), worlds.vehicles, vehicle)
        step = np.rint((worlds.time_s - self._clock[:, START]) / self._clock[:, TIME_STEP]).astype(np.int64)
        rows = np.flatnonzero((step >= 0) & (step < self.actions.shape[1]))
        self.actions[rows, step[rows]] = action[rows]
        return action_to_command(action, worlds.vehicles, vehicle)


def _put(old: NDArray[Number], rows: Ints, new: NDArray[Number]) -> NDArray[Number]:
    placed = old.copy()
    placed[rows] = new
    return placed


def _taken(running: Running, rows: Ints) -> Running:
    problem = running.problem
    arrays: dict[str, Any] = {name: getattr(problem, name)[rows] for name in _PER_WORLD}
    return Running(replace(problem, **arrays), running.states[rows], running.steps[rows], running.ended[rows])


def _harm_of(running: Running, plan: Floats, rows: Ints) -> Floats:
    """Harm of the plans in some of the worlds."""
    return plan_harm(_taken(running, rows), plan[rows])
