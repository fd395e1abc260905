"""Step mode of the shield: a guaranteed harm that holds at every step, whoever proposes the actions.

**Claim.** Let ``B`` be the bound at the first decision: the harm of the backup plan, executed in the engine. If in each
step what ``certify`` says is applied, the harm realised at the end of the episode is at most ``B``, whatever is
proposed; and the bound never rises on the way. The end is rest or the scenario's horizon: of what still moves then, and
of what happens afterwards, nothing is claimed.

**Induction.** Between two decisions the shield holds a *plan* (an action for every decision up to the horizon) and its
harm ``c``: the harm of the whole episode, past harm and which pairs were hit before included, if that plan is executed
from the present state. Both come out of one function, ``follow_plan``, which advances decision by decision with the
operations of the engine's step in their order, and adds harm in its order. So:

1. *Start.* ``c = B``.
2. *The proposal is applied* only with a plan from the next state whose harm, computed by ``follow_plan`` from that very
   state, is at most the budget; that plan is held from now on, and ``c`` is its harm. (If the proposal is what the plan
   says, the rest of the plan is that plan, with the same ``c``: the same operations on the same numbers.)
3. *The plan's action is applied* otherwise. The rest of the plan is executed from a state that ``follow_plan`` passed
   through when it found ``c``: the harm remains ``c`` to the last bit. A plan that harms less may replace it.
4. *End.* When the episode ends nothing is left to execute, and ``c`` is the harm realised.

The budget is ``c`` (or anything between ``c`` and ``B``), so ``c <= B`` always. ∎ No tolerance enters: where the engine
does what it is said to do, realised harm and the last bound are the same double.

**Several vehicles.** Where several are shielded, an action above is a row of them, one for each vehicle, and so is each
entry of the plan; what is proven is the same. All proposals together are tried first. If they have no certificate, the
vehicles are taken from front to rear: each proposal replaces that vehicle's action in the joint plan, and is accepted
with a plan behind it whose harm is at most the budget; otherwise that vehicle's planned action stays. Each attempt
begins with a plan that is certified, and ends with one.

**Several members.** Where a world has more than one (``shield.uncertainty``), every harm above is the largest over
them, each member being advanced by the same actions: then the realised harm of *every* member is at most ``B``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command, command_to_action
from ethbrake_marl.agents.protocol import Agent, AgentAround, Team, is_divisible
from ethbrake_marl.agents.rollout import drive, script_agents, set_others
from ethbrake_marl.engine.stream import ask_script
from ethbrake_marl.errors import InvalidInput, PhysicsError, renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import Packed, command_at, gap_at, has_obstacle, speed_at, state_width, vehicles_in
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.kernel import CLOCK, ROW, at_rest, decision_at, decision_s
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import ProfileProblem, worlds_at
from ethbrake_marl.shield.certify_kernel import (
    ENDED,
    NO_CERTIFICATE,
    NOT_A_NUMBER,
    Members,
    borne_by,
    certify_worlds,
    follow_plan,
    gather,
    harm_of_plans,
    rows_of,
)

REASONS = (
    "same as plan",  # the proposal is the plan's action
    "plan remains",  # the rest of the plan still keeps the budget after the proposal
    "constant",  # a constant action after the proposal keeps it
    "no certificate",  # neither does: the plan's action was applied
    "not a number",  # nothing usable was proposed: the plan's action was applied
    "ended",  # the episode is over
    "assumption broken",  # the world did not do what was predicted: the fallback was applied
    "policy rollout",  # nothing else kept the budget, but the policy itself does, rolled out after the proposal
)
CONSTANTS = tuple(-k / 10 for k in range(11))  # actions that are tried as constants: coasting to full braking


class Running(NamedTuple):
    """Running episodes at a decision, as the shield knows them: n worlds with M members each (``shield.uncertainty``).

    World k's members are the rows k * M to k * M + M - 1, the nominal one first; without uncertainty M is 1. Of several
    shielded vehicles, proposals and actions are [n, K], and plans [n, L, K]; of one they are [n] and [n, L], or [n, 1]
    and [n, L, 1].
    """

    problem: ProfileProblem  # parameters, commands of the others, grid of decisions; K vehicles; n * M rows
    states: Floats  # [n * M, S] of ``physics.episode``: speeds, gaps, hit flags, both harms so far
    steps: Ints  # [n] number of the decision
    ended: Bools  # [n * M]
    caps: Floats = np.zeros((0, 0))  # [n * M, N] most harm that each vehicle may bear (m2/s2); [0, 0]: any

    @property
    def n(self) -> int:
        """Number of worlds."""
        return len(self.steps)

    @property
    def members(self) -> int:
        """Number of members of each world (M)."""
        return len(self.ended) // max(self.n, 1)

    @property
    def finished(self) -> Bools:
        """Worlds in which every member's episode is over, [n]."""
        return np.asarray(self.ended.reshape(self.n, -1).all(axis=1), np.bool_)

    @property
    def time_s(self) -> Floats:
        """Time of the decision in the nominal member, [n] s."""
        clock = self.problem.clock[:: self.members]
        return decision_s(clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP], self.steps)

    def rows_of(self, worlds: Ints) -> Ints:
        """The rows of the members of some worlds."""
        rows: Ints = (worlds[:, np.newaxis] * self.members + np.arange(self.members)).ravel()
        return rows

    def take(self, worlds: Ints) -> Running:
        """Some of the worlds, with all their members."""
        return self._select(self.rows_of(worlds), worlds)

    def nominal(self) -> Running:
        """Every world with its nominal member alone."""
        if self.members == 1:
            return self
        return self._select(np.arange(self.n) * self.members, np.arange(self.n))

    def _select(self, rows: Ints, worlds: Ints) -> Running:
        caps = self.caps[rows] if self.caps.size else self.caps
        return Running(self.problem.take(rows), self.states[rows], self.steps[worlds], self.ended[rows], caps)


class Backup(NamedTuple):
    """What is executed if nothing else is certified."""

    plan: Floats  # [n, L] or [n, L, K] actions, column j for decision j
    harm: Floats  # [n] of the episode if it is executed from now on, in the worst member (m2/s2)
    constants: Floats = np.array(CONSTANTS)  # [C] or [C, K] actions that may replace the rest of a plan


class Decision(NamedTuple):
    """What is applied, why, and what holds from now on."""

    applied: Floats  # [n] or [n, K] actions in [-1, 1]
    intervened: Bools  # [n] or [n, K] what is applied is not what was proposed (clipped)
    reason: NDArray[np.int64]  # [n] or [n, K] places in REASONS
    bound: Floats  # [n] harm of the episode is at most this from now on (m2/s2)
    margin: Floats  # [n] or [n, K] budget minus the least harm found after the proposal; negative: why it was rejected
    after: Running  # as it will be at the next decision
    backup: Backup  # the plan that goes with the bound


def begin_running(problem: ProfileProblem, members: int = 1) -> Running:
    """The episodes of a problem at their first decision; its rows are worlds with ``members`` each."""
    steps, ended = np.zeros(problem.n // members, np.int64), np.zeros(problem.n, np.bool_)
    return Running(problem, problem.start, steps, ended)


def plan_harm(running: Running, plan: Floats) -> Floats:
    """Harm of the episodes, in the worst member, if the plans are executed from here, [n] m2/s2; whoever bears it.

    It is to the engine's bits.
    """
    return bettered_plan(running, plan, np.zeros(0))[1]


def bettered_plan(running: Running, plan: Floats, constants: Floats) -> tuple[Floats, Floats]:
    """The plans, or where it harms less in the worst member the best of the constant actions; and that harm."""
    problem, value = running.problem, np.empty(running.n)
    _check_plan(running, plan)
    plans = np.array(plan, np.float64, order="C")
    harm_of_plans(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, no_caps(problem.n), problem.vehicles,
        _of_each_vehicle(constants, problem), plans.reshape(*plans.shape[:2], len(problem.vehicles)), value,
    )  # fmt: skip
    _raise_if_any(~np.isfinite(value))
    return plans, value


def from_now(past: Floats, later: Floats | float, steps: Ints) -> Floats:
    """The plans that are ``past`` before the decisions ``steps`` [n], which was applied, and ``later`` after."""
    made = np.arange(past.shape[1]) < steps[:, np.newaxis]
    return np.where(made if past.ndim == 2 else made[:, :, np.newaxis], past, later)


def certify(running: Running, proposed: Floats, backup: Backup, budget: Floats) -> Decision:
    """Decide in every world which proposed actions ([n], or [n, K]) are applied, and where the backup's; see the claim.

    ``budget`` [n] is the harm that is guaranteed, at least the backup's. A proposal beyond [-1, 1] is clipped first;
    one that is no number is replaced. Nothing given is changed. Raises ``InvalidInput`` for shapes that do not fit or a
    budget below the backup's harm, ``PhysicsError`` naming the worlds that cannot be advanced by what would be applied.
    """
    n, problem, vehicles = running.n, running.problem, len(running.problem.vehicles)
    _check_plan(running, backup.plan)
    given = np.ascontiguousarray(proposed, np.float64)
    shape = (n, *backup.plan.shape[2:])
    if not (given.shape == shape and backup.harm.shape == budget.shape == (n,)):
        raise InvalidInput(
            f"certify: proposed {given.shape}, backup's harm {backup.harm.shape}, budget {budget.shape};"
            f" {shape}, and twice ({n},) needed"
        )
    if not (budget >= backup.harm).all():
        raise InvalidInput("certify: a budget is below the backup's harm; nothing could be guaranteed")
    plans, after, out = backup.plan.copy(), np.empty_like(running.states), np.empty((n, vehicles, 4))
    over, failed = np.zeros(problem.n, np.bool_), np.zeros(n, np.bool_)
    certify_worlds(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, running.caps if running.caps.size else no_caps(problem.n),
        problem.vehicles, given.reshape(n, vehicles), budget, backup.harm,
        _of_each_vehicle(backup.constants, problem), plans.reshape(n, plans.shape[1], vehicles), after, out, over,
        failed,
    )  # fmt: skip
    _raise_if_any(failed)
    applied, bound, margin = out[:, :, 0].reshape(shape), out[:, 0, 2].copy(), out[:, :, 3].reshape(shape)
    reason = out[:, :, 1].astype(np.int64).reshape(shape)
    intervened = (reason == NO_CERTIFICATE) | (reason == NOT_A_NUMBER)
    later = running._replace(states=after, steps=running.steps + ~running.finished, ended=over)
    return Decision(applied, intervened, reason, bound, margin, later, backup._replace(plan=plans, harm=bound))


def _raise_if_any(failed: Bools) -> None:
    if failed.any():
        raise PhysicsError({k: "the shield could not follow its plan" for k in np.flatnonzero(failed).tolist()})


def no_caps(rows: int) -> Floats:
    """No limit to what a vehicle may bear, for so many members."""
    return np.zeros((rows, 0))


def _of_each_vehicle(constants: Floats, problem: ProfileProblem) -> Floats:
    """Constant actions [C, K]; those [C] of one vehicle, or none, with an axis of vehicles."""
    return constants.reshape(len(constants), len(problem.vehicles))


def _check_plan(running: Running, plan: Floats) -> None:
    most = int(running.problem.last_step.max(initial=0))
    vehicles = len(running.problem.vehicles)
    fits = vehicles == 1 if plan.ndim == 2 else plan.shape[2:] == (vehicles,)
    if not fits or plan.shape[0] != running.n or plan.shape[1] < most:
        wanted = f"({running.n}, at least {most}{'' if vehicles == 1 else f', {vehicles}'})"
        raise InvalidInput(f"shield: plan {plan.shape}; {wanted} is needed")


# The comparison of what happened with what was predicted: to the last bit, the harm so far included.

SLACK = 1e-9  # by more than this (m, m/s) a world lies outside what several members predict; one member is exact
GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))  # of each pair


def seen_columns(packed: Packed) -> Floats:
    """Running worlds and their harm so far in the columns of ``Running.states``, [n, S]: to be compared with them.

    Those are speeds, gaps, hit flags and both harms, with the obstacle first in each group where there is one. Raises
    ``InvalidInput`` where only some of the worlds have one.
    """
    state = packed.state
    N = vehicles_in(state)
    speeds, first, pairs = state[:, speed_at(N) : command_at(N)], gap_at(N), N - 1
    if has_obstacle(state, N) and (ahead := np.isfinite(state[:, state_width(N)])).any():
        if not ahead.all():
            raise InvalidInput("shield: only some of the worlds have an obstacle ahead (obstacle_gap_m), not all")
        groups = [state[:, first + g * pairs : first + (g + 1) * pairs] for g in range(len(GROUPS))]
        at = state_width(N)
        whole = [part for g, group in enumerate(groups) for part in (state[:, at + g : at + g + 1], group)]
        return np.concatenate([np.zeros((len(state), 1)), speeds, *whole], axis=1)
    return np.concatenate([speeds, state[:, first : first + len(GROUPS) * pairs]], axis=1)


def as_predicted(running: Running, seen: Floats) -> Bools:
    """Where what is seen [n, columns] does not contradict the prediction, [n].

    One member: where it is what was predicted, to the bit. Several: where it lies within the range of their
    predictions, by column; once one of them has had an impact, worlds between the corners may leave that range, and any
    finite numbers will do.
    """
    columns, N = seen.shape[1], (running.states.shape[1] + 4) // 5
    if running.members == 1:
        same: Bools = (seen == running.states[:, :columns]).all(axis=1)
        return same
    predicted = running.states.reshape(running.n, running.members, -1)
    low, high = predicted[:, :, :columns].min(axis=1) - SLACK, predicted[:, :, :columns].max(axis=1) + SLACK
    within: Bools = ((seen >= low) & (seen <= high)).all(axis=1)
    had_impact = (predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2))
    within |= had_impact & np.isfinite(seen).all(axis=1)
    return within


def difference(predicted: Floats, seen: Floats) -> str:
    """The first number in which a world as seen [S] is not as predicted [S], in words; "nothing" where all are."""
    vehicles = (len(predicted) + 4) // 5
    for column in np.flatnonzero(~(seen == predicted)).tolist():
        if column < vehicles:
            what, unit = f"speed of vehicle {column + 1} of the line", " m/s"
        else:
            group, pair = divmod(column - vehicles, vehicles - 1)
            what, unit = f"{GROUPS[group][0]} of pair {pair + 1}", GROUPS[group][1]
        return f"{what} is {seen[column]:.17g}{unit}, certified was {predicted[column]:.17g}{unit}"
    return "nothing"


# The test whether a world comes to rest before the horizon, where every bound ends.


def plan_rests(running: Running, plan: Floats) -> Bools:
    """Where everything rests at the horizon if the plans are executed from here, in every member, [n]."""
    problem, rests = running.problem, np.empty(running.n, np.bool_)
    rests_after_plans(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, no_caps(problem.n), problem.vehicles,
        np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(problem.vehicles)), rests,
    )  # fmt: skip
    return rests


@compiled
def rests_after_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, plans: Floats, rests: Bools,
) -> None:  # fmt: skip
    """Fill ``rests`` [n]: under the plan every member of the world comes to rest before the horizon, and stays so."""
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((ROW.OF_EPISODE, N)), np.zeros(1, np.int64)
    M = states.shape[0] // max(n, 1)
    lines = np.empty((states.shape[0], rows_of(caps), N))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(n):
        rests[k] = True
        for m in range(k * M, k * M + M):
            follow_plan(world, m, states[m], ended[m], steps[k], plans[k], math.inf)
            rests[k] = rests[k] and at_rest(table)


# Each vehicle's share under a plan: the harm of its pairs, split by mass as in the ledger, to the same bits.


def borne_under(running: Running, plan: Floats) -> Floats:
    """Harm of the whole episode that each vehicle bears if the plans are executed from here, [n * M, N] m2/s2.

    With an obstacle ahead its column comes first, and is 0.
    """
    problem = running.problem
    borne = np.empty(problem.mass.shape)
    borne_under_plans(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command,
        problem.latency, problem.mass, problem.limit, no_caps(problem.n), problem.vehicles,
        np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(problem.vehicles)), borne,
    )  # fmt: skip
    return borne


def keeps_caps(running: Running, plan: Floats) -> Bools:
    """Where no vehicle bears more than it may if the plans are executed from here, [n]; everywhere without caps."""
    if not running.caps.size:
        return np.ones(running.n, np.bool_)
    within = (borne_under(running, plan) <= running.caps).all(axis=1)
    return np.asarray(within.reshape(running.n, -1).all(axis=1), np.bool_)


@compiled
def borne_under_plans(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, plans: Floats, borne: Floats,
) -> None:  # fmt: skip
    """Fill ``borne`` [n * M, N]."""
    N, n = mass.shape[1], steps.shape[0]
    table, critical = np.zeros((ROW.OF_EPISODE, N)), np.zeros(1, np.int64)
    M = states.shape[0] // max(n, 1)
    lines = np.empty((states.shape[0], rows_of(caps), N))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(n):
        for m in range(k * M, k * M + M):
            follow_plan(world, m, states[m], ended[m], steps[k], plans[k], math.inf)
            for i in range(N):
                borne[m, i] = borne_by(table, clock[m, CLOCK.HARM_IS_TOTAL], i)


# The log of a step shield: every decision in which something else than the proposal was applied.


class Intervention(NamedTuple):
    """One decision in which something else than the proposal was applied."""

    world: int  # row of the batch
    vehicle: int  # index of the shielded vehicle, 0 = front
    episode: int  # of that row, from 0
    step: int  # number of the decision
    time_s: float
    proposed: float  # action, as it was given
    applied: float  # action
    reason: int  # place in REASONS
    bound: float  # m2/s2, from now on
    margin: float  # m2/s2; negative: what the proposal would have cost beyond the budget at least
    state: Floats  # [S] at the decision
    plan: Floats  # [L] that was held, of several vehicles [L, K]; before ``step`` what was applied


def interventions(
    now: Running, episode: Ints, vehicles: Sequence[int], proposed: Floats, decision: Decision, held: Backup
) -> list[Intervention]:
    """What a decision made from ``now`` replaced; ``episode`` [n] numbers the rows' episodes."""
    times, states, shape = now.time_s, now.nominal().states, (now.n, len(vehicles))
    columns = (proposed, decision.applied, decision.reason, decision.margin, decision.intervened)
    given, applied, reason, margin, replaced = (np.reshape(column, shape) for column in columns)
    return [
        Intervention(
            k, vehicles[c], int(episode[k]), int(now.steps[k]), float(times[k]), float(given[k, c]),
            float(applied[k, c]), int(reason[k, c]), float(decision.bound[k]), float(margin[k, c]), states[k].copy(),
            held.plan[k].copy(),
        )
        for k, c in np.argwhere(replaced).tolist()
    ]  # fmt: skip


# Rollouts of the policies that propose: their actions from the alert, and from any later decision, as plans.
#
# What a rollout does is written down as a plan and certified like any other (``shield.certify.plan_harm``): a policy
# that
# would drive differently the second time costs interventions, never the bound.

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
    group = 1 if running.problem.clock[0, CLOCK.HARM_IS_TOTAL] == 1.0 else 0
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
        step = decision_at(worlds.time_s, self._clock[:, CLOCK.START], self._clock[:, CLOCK.TIME_STEP])
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
