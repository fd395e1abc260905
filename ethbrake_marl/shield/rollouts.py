"""Rollouts of the policy that proposes: its actions from the alert, and from any later decision, as plans.

What a rollout does is written down as a plan and certified like any other (``shield.certify.plan_harm``): a policy that
would drive differently the second time costs interventions, never the bound.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command, command_to_action
from ethbrake_marl.agents.protocol import Agent, AgentAround, is_divisible
from ethbrake_marl.agents.rollout import drive, script_agents, set_others
from ethbrake_marl.engine.stream import ask_script
from ethbrake_marl.errors import renumbered
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import HARM_IS_TOTAL, START, TIME_STEP, decision_at
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import ProfileProblem, worlds_at
from ethbrake_marl.shield.certify import Backup, Decision, Running, certify, from_now, plan_harm
from ethbrake_marl.shield.certify_kernel import ENDED

ROLLOUT = ENDED + 2  # a reason that the kernel does not know
Number = TypeVar("Number", bound=np.generic)


class Proposer(NamedTuple):
    """Who proposes, and what it sees now: enough to try, on copies, what it would do later."""

    policy: Agent  # its memory is that of the running episodes, this decision's action included; never changed
    worlds: Worlds  # [n] now


def rolled_out(
    worlds: Worlds, policy: Agent, scenario: Scenario, vehicle: int, problem: ProfileProblem, width: int
) -> Floats:
    """The actions [n, width] of a policy that drives alone from the alert; full braking beyond its episode's end."""
    recorder = _Recorder(copy.deepcopy(policy), problem, width)
    set_others(recorder.policy, vehicle, script_agents(scenario, except_for=vehicle))
    drive(worlds, recorder, scenario, vehicle)
    return recorder.actions


def certify_rollouts(
    running: Running, proposed: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Decision:
    """Decide again in ``rows``, where the proposals found no certificate, with the policy itself as the later plan.

    The plan that is tried is the proposal (clipped, a number), then what the policy does from the state after it. Where
    it keeps the budget it becomes the backup, and the proposal is "what the plan says"; elsewhere the reason says that
    something else must be applied. ``running``, ``proposed``, ``budget`` and the plans ``held`` [n, L] are those of the
    whole batch. Returns the decision of those rows alone.
    """
    part, first, least = running.take(rows), np.clip(proposed[rows], -1.0, 1.0), budget[rows]
    plan = _later_plan(running.nominal(), first, rows, budget, held, proposer)
    with renumbered(rows):
        harm = plan_harm(part, plan)
        kept = harm <= least
        decision = certify(part, first, Backup(plan, harm), np.maximum(least, harm))
    return decision._replace(intervened=~kept, margin=least - harm)


def _later_plan(
    running: Running, first: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Floats:
    """The plans [m, L] of ``rows``: what was applied, the ``first`` action [m], then the policy's.

    Given up once above the budget.
    """
    policy, worlds = proposer
    driver, batch = _apart(policy, rows, worlds.n)
    seen, wanted = worlds.take(batch), np.isin(batch, rows)
    episodes, most = running.take(batch), budget[batch]
    episodes = episodes._replace(ended=episodes.ended | ~wanted)
    added = episodes.problem.command.shape[1] - worlds.N  # an obstacle ahead is vehicle 0 of the problem
    vehicle, action = int(episodes.problem.vehicles[0]) - added, np.zeros(len(batch))
    action[wanted] = first
    plan, nothing, no_constants = from_now(held[batch], -1.0, episodes.steps), np.zeros(len(batch)), np.zeros(0)
    while True:
        going = np.flatnonzero(~episodes.ended)
        plan[going, episodes.steps[going]] = action[going]
        with renumbered(batch):
            episodes = certify(episodes, action, Backup(plan, nothing, no_constants), nothing).after
        episodes = episodes._replace(ended=episodes.ended | (harm_so_far(episodes) > most))
        if episodes.ended.all():
            return plan[wanted]
        seen = _seen(seen, episodes, action_to_command(action, seen.vehicles, vehicle))
        action = _or_braking(proposed_action(driver, seen, vehicle))


def proposed_action(policy: Agent, worlds: Worlds, vehicle: int) -> Floats:
    """What a policy proposes, as actions [n] in [-1, 1]; a command that is no number stays none."""
    command = ask_script(policy, worlds, vehicle)
    return np.where(np.isnan(command), np.nan, command_to_action(command, worlds.vehicles, vehicle))


def _or_braking(action: Floats) -> Floats:
    """In a rollout full braking stands for what is no number: the shield would not apply that either."""
    return np.where(np.isnan(action), -1.0, action)


def _apart(policy: Agent, rows: Ints, n: int) -> tuple[Agent, Ints]:
    """A policy that goes on without changing this one, and the rows of the batch that it drives: all, if it must."""
    if is_divisible(policy):
        return policy.take(rows), rows
    return copy.deepcopy(policy), np.arange(n)


def harm_so_far(running: Running) -> Floats:
    """Harm of the episodes up to now under the count that is guaranteed, [n] m2/s2."""
    pairs = (running.states.shape[1] - 1) // 5  # the width is N + 4 (N - 1)
    group = 1 if running.problem.clock[0, HARM_IS_TOTAL] == 1.0 else 0
    last = running.states.shape[1] - (1 - group) * pairs
    harm: Floats = running.states[:, last - pairs : last].sum(axis=1)
    return harm


def _seen(worlds: Worlds, running: Running, command_mps2: Floats) -> Worlds:
    """The worlds as a driver sees them at the decisions of ``running``, its last commands [n] in force."""
    N, problem = worlds.N, running.problem
    commands = problem.command.copy()
    commands[:, problem.vehicles[0]] = command_mps2
    commands = commands[:, -N:]  # without an obstacle ahead
    time = running.time_s
    return replace(
        worlds_at(worlds, running.states),
        time_s=time,
        command_mps2=np.where(worlds.vehicles.latency_s <= time[:, np.newaxis], commands, 0.0),
    )


class _Recorder(AgentAround):
    """A policy whose actions are written down, and applied as they are written."""

    def __init__(self, policy: Agent, problem: ProfileProblem, width: int) -> None:
        super().__init__(policy)
        self.actions = np.full((problem.n, width), -1.0)
        self._clock = problem.clock

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The policy's action, rounded as it is written."""
        action = _or_braking(proposed_action(self.policy, worlds, vehicle))
        step = decision_at(worlds.time_s, self._clock[:, START], self._clock[:, TIME_STEP])
        rows = np.flatnonzero((step >= 0) & (step < self.actions.shape[1]))
        self.actions[rows, step[rows]] = action[rows]
        return action_to_command(action, worlds.vehicles, vehicle)


def merged(decision: Decision, rows: Ints, found: Decision) -> Decision:
    """A batch's decision with that of ``rows`` replaced where the policy's rollout kept the budget."""
    margin = decision.margin.copy()
    margin[rows] = np.maximum(margin[rows], found.margin)
    kept = np.flatnonzero(~found.intervened)
    at, after, plan = rows[kept], found.after, found.backup.plan
    assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()  # one past
    return Decision(
        put(decision.applied, at, found.applied[kept]),
        put(decision.intervened, at, found.intervened[kept]),
        put(decision.reason, at, np.full(len(at), ROLLOUT)),
        put(decision.bound, at, found.bound[kept]),
        margin,
        decision.after._replace(
            states=put(decision.after.states, decision.after.rows_of(at), after.states[after.rows_of(kept)]),
            ended=put(decision.after.ended, decision.after.rows_of(at), after.ended[after.rows_of(kept)]),
        ),
        decision.backup._replace(
            plan=put(decision.backup.plan, at, plan[kept]), harm=put(decision.backup.harm, at, found.bound[kept])
        ),
    )


def put(old: NDArray[Number], rows: Ints, new: NDArray[Number]) -> NDArray[Number]:
    """A copy of ``old`` with ``new`` in these rows."""
    placed = old.copy()
    placed[rows] = new
    return placed
