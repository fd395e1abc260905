"""Rollouts of the policies that propose: their actions from the alert, and from any later decision, as plans.

What a rollout does is written down as a plan and certified like any other (``shield.certify.plan_harm``): a policy that
would drive differently the second time costs interventions, never the bound.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command, command_to_action
from ethbrake_marl.agents.protocol import Agent, AgentAround, is_divisible
from ethbrake_marl.agents.rollout import drive, script_agents, set_others
from ethbrake_marl.agents.team import Team
from ethbrake_marl.engine.stream import ask_script
from ethbrake_marl.errors import renumbered
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.physics.episode import HARM_IS_TOTAL, START, TIME_STEP, decision_at
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import ProfileProblem, worlds_at
from ethbrake_marl.shield.certify import Backup, Decision, Running, certify, from_now, plan_harm
from ethbrake_marl.shield.certify_kernel import ENDED, NO_CERTIFICATE, NOT_A_NUMBER
from ethbrake_marl.shield.shares import keeps_caps

ROLLOUT = ENDED + 2  # a reason that the kernel does not know
Number = TypeVar("Number", bound=np.generic)


class Proposer(NamedTuple):
    """Who proposes, and what they see now: enough to try, on copies, what they would do later."""

    policies: Mapping[int, Agent]  # by shielded vehicle, front to rear; their memory is that of the running episodes,
    # this decision's action included; never changed
    worlds: Worlds  # [n] now


def rolled_out(
    worlds: Worlds,
    policies: Mapping[int, Agent],
    scenario: Scenario,
    vehicle: int | tuple[int, ...],
    problem: ProfileProblem,
    width: int,
) -> Floats:
    """The actions [n, width] (several vehicles: [n, width, K]) of policies that drive unshielded from the alert.

    Full braking beyond their episode's end.
    """
    recorders = {i: _Recorder(policy, problem, width) for i, policy in copy.deepcopy(dict(policies)).items()}
    scripts = script_agents(scenario, except_for=list(recorders))
    for i, recorder in recorders.items():
        set_others(recorder.policy, i, scripts)
    drive(worlds, Team(recorders, next(iter(policies.values())).name), scenario)
    if isinstance(vehicle, int):
        return recorders[vehicle].actions
    return np.stack([recorders[i].actions for i in vehicle], axis=2)


def certify_rollouts(
    running: Running, proposed: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Decision:
    """Decide again in ``rows``, where the proposals found no certificate, with the policy itself as the later plan.

    The plan that is tried is the proposal (clipped, a number), then what the policy does from the state after it. Where
    it keeps the budget it becomes the backup, and the proposal is "what the plan says"; elsewhere the reason says that
    something else must be applied. ``running``, ``proposed``, ``budget`` and the plans ``held`` are those of the
    whole batch. Of several vehicles, who proposes no number keeps its planned action. Returns the decision of those
    rows alone.
    """
    part, least, silent = running.take(rows), budget[rows], np.isnan(proposed[rows])
    planned = held[rows, np.minimum(running.steps[rows], held.shape[1] - 1)]
    first = np.where(silent, planned, np.clip(proposed[rows], -1.0, 1.0))
    plan = _later_plan(running.nominal(), first, rows, budget, held, proposer)
    with renumbered(rows):
        harm = plan_harm(part, plan)
        kept = (harm <= least) & keeps_caps(part, plan)
        decision = certify(part, first, Backup(plan, harm, no_constants(plan)), np.maximum(least, harm))
    each = kept.reshape(-1, *[1] * (first.ndim - 1))
    told = np.where(silent, NOT_A_NUMBER, ROLLOUT)
    margin = np.broadcast_to((least - harm).reshape(each.shape), first.shape)
    return decision._replace(intervened=silent | ~each, margin=margin, reason=np.where(each, told, NO_CERTIFICATE))


def _later_plan(
    running: Running, first: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Floats:
    """The plans of ``rows``: what was applied, the ``first`` action ([m] or [m, K]), then the policies'.

    Given up once above the budget.
    """
    policies, worlds = proposer
    drivers, batch = _apart(policies, rows, worlds.n)
    seen, wanted = worlds.take(batch), np.isin(batch, rows)
    episodes, most = running.take(batch), budget[batch]
    episodes = episodes._replace(ended=episodes.ended | ~wanted)
    action = np.zeros((len(batch), *first.shape[1:]))
    action[wanted] = first
    plan, nothing = from_now(held[batch], -1.0, episodes.steps), np.zeros(len(batch))
    while True:
        going = np.flatnonzero(~episodes.ended)
        plan[going, episodes.steps[going]] = action[going]
        with renumbered(batch):
            episodes = certify(episodes, action, Backup(plan, nothing, no_constants(plan)), nothing).after
        episodes = episodes._replace(ended=episodes.ended | (harm_so_far(episodes) > most))
        if episodes.ended.all():
            return plan[wanted]
        seen = _seen(seen, episodes, list(policies), action)
        action = _or_braking(proposed_actions(drivers, seen, action.ndim == 1))


def no_constants(plan: Floats) -> Floats:
    """No constant action to replace the rest of a plan."""
    return np.zeros((0, *plan.shape[2:]))


def proposed_actions(policies: Mapping[int, Agent], worlds: Worlds, single: bool) -> Floats:
    """What the policies propose, [n] of the only one where it is a ``single`` shield's, else [n, K]."""
    columns = [proposed_action(policy, worlds, vehicle) for vehicle, policy in policies.items()]
    return columns[0] if single else np.stack(columns, axis=1)


def proposed_action(policy: Agent, worlds: Worlds, vehicle: int) -> Floats:
    """What a policy proposes, as actions [n] in [-1, 1]; a command that is no number stays none."""
    command = ask_script(policy, worlds, vehicle)
    return np.where(np.isnan(command), np.nan, command_to_action(command, worlds.vehicles, vehicle))


def _or_braking(action: Floats) -> Floats:
    """In a rollout full braking stands for what is no number: the shield would not apply that either."""
    return np.where(np.isnan(action), -1.0, action)


def _apart(policies: Mapping[int, Agent], rows: Ints, n: int) -> tuple[dict[int, Agent], Ints]:
    """Policies that go on without changing these, and the rows of the batch that they drive: all, if one must."""
    parts = {i: policy.take(rows) for i, policy in policies.items() if is_divisible(policy)}
    if len(parts) == len(policies):
        return parts, rows
    return copy.deepcopy(dict(policies)), np.arange(n)


def harm_so_far(running: Running) -> Floats:
    """Harm of the episodes up to now under the count that is guaranteed, [n] m2/s2."""
    pairs = (running.states.shape[1] - 1) // 5  # the width is N + 4 (N - 1)
    group = 1 if running.problem.clock[0, HARM_IS_TOTAL] == 1.0 else 0
    last = running.states.shape[1] - (1 - group) * pairs
    harm: Floats = running.states[:, last - pairs : last].sum(axis=1)
    return harm


def _seen(worlds: Worlds, running: Running, vehicles: list[int], action: Floats) -> Worlds:
    """The worlds as a driver sees them at the decisions of ``running``, the last actions of ``vehicles`` in force."""
    commands = running.problem.command[:, -worlds.N :].copy()  # without an obstacle ahead
    for c, vehicle in enumerate(vehicles):
        column = action if action.ndim == 1 else action[:, c]
        commands[:, vehicle] = action_to_command(column, worlds.vehicles, vehicle)
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
    """A batch's decision with that of ``rows`` replaced where the policies' rollout kept the budget."""
    margin = decision.margin.copy()
    margin[rows] = np.maximum(margin[rows], found.margin)
    kept = np.flatnonzero((found.reason != NO_CERTIFICATE).reshape(len(rows), -1).all(axis=1))
    at, after, plan = rows[kept], found.after, found.backup.plan
    assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()  # one past
    return Decision(
        put(decision.applied, at, found.applied[kept]),
        put(decision.intervened, at, found.intervened[kept]),
        put(decision.reason, at, found.reason[kept]),
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
