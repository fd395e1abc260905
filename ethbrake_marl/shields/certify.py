"""``certify``: apply the proposed action if a plan behind it keeps the budget, else apply the backup plan's action.

A *plan* holds one action for each decision up to the horizon. The *backup* is the plan that the shield currently holds.
The *budget* is the largest harm that the shield accepts for the whole episode. A *member* is one of the possible worlds
that a world stands for. Each plan is simulated in every member, with the kernels of ``members``. Two plans are tried
after a proposal: the rest of the current plan, then the best constant action. ``step`` proves that the harm of the
episode then never exceeds the first bound.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics.episode import CLOCK, at_rest
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Bools, Floats, Ints
from ethbrake_marl.shields.members import (
    Members,
    all_members,
    borne_by,
    follow_plan,
    hold_constant,
    members_from,
    take_steps,
    worst_of_plan,
    worst_so_far,
)
from ethbrake_marl.shields.reasons import (
    CONSTANT,
    ENDED,
    NO_CERTIFICATE,
    NOT_A_NUMBER,
    PLAN_REMAINS,
    SAME_AS_PLAN,
    ShieldReason,
)
from ethbrake_marl.shields.running import Running, put

APPLIED, REASON, BOUND, MARGIN = range(4)  # columns of the decision of one vehicle

# A constant action is first simulated in one segment. If its harm (m2/s2) is above the limit by at most this much, the
# exact simulation, decision by decision, still gets its chance.
NEARLY = 1e-9


@compiled(apart=True)
def best_constant(world: Members, states: Floats, ended: Bools, step: int, constants: Floats) -> tuple[int, float]:
    """Return the index of the constant action with the least worst-case harm, and that harm (m2/s2).

    Each action is held from now to the horizon, simulated in one segment.

    Args:
        world: the M possible worlds of one world (``Members``); the worst case is over them.
        states: [M, S] their states now, in the layout of ``Running.states``.
        ended: [M] whether their episodes have ended.
        step: number of the present decision.
        constants: [C, K] actions of the K shielded vehicles.

    """
    best, least, critical = 0, math.inf, 0
    for c in range(constants.shape[0]):
        worst, first = 0.0, critical
        for j in range(ended.shape[0]):
            m = (first + j) % ended.shape[0]
            value = hold_constant(world, m, states[m], ended[m], step, constants, c)
            if value > worst:
                worst, critical = value, m
            if not worst < least:
                break
        if worst < least:
            best, least = c, worst
    return best, least


@compiled(apart=True)
def better_plan(
    world: Members, states: Floats, ended: Bools, step: int, constants: Floats, value: float, most: float,
    plan: Floats, trial: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Replace the rest of a plan by the best constant action, if this reduces its harm.

    A plan holds one action for each decision. The replacement requires a harm below ``value`` and at most ``most``.

    Args:
        world: the M possible worlds of one world (``Members``).
        states: [M, S] their states now, in the layout of ``Running.states``.
        ended: [M] whether their episodes have ended.
        step: number of the present decision, from which on the plan is replaced.
        constants: [C, K] constant actions.
        value: harm of the plan in the worst possible world, m2/s2.
        most: largest accepted harm, m2/s2.
        plan: [L, K] changed in place.
        trial: [L, K] workspace.

    Returns the harm of the plan afterwards, and the least harm found, certified or not.

    """
    so_far = worst_so_far(world, states)
    if value <= so_far or so_far > most:  # nothing can be better
        return value, min(value, so_far) if value <= so_far else so_far
    best, least = best_constant(world, states, ended, step, constants)
    if not least < value or least > most + NEARLY:
        return value, min(value, least)
    for j in range(step, trial.shape[0]):
        copy_action(constants[best], trial[j])
    certified = worst_of_plan(world, states, ended, step, trial, most)
    if not certified < value:
        return value, min(value, least)
    for j in range(step, plan.shape[0]):
        copy_action(constants[best], plan[j])
    return certified, certified


@compiled
def copy_action(action: Floats, to: Floats) -> None:
    """Copy the numbers of ``action`` into ``to``, which is as long; usually one action per shielded vehicle."""
    for c in range(to.shape[0]):
        to[c] = action[c]


@compiled
def is_planned(action: Floats, planned: Floats) -> bool:
    """Return whether ``action`` [K] equals the ``planned`` action [K] for all shielded vehicles."""
    for c in range(planned.shape[0]):  # noqa: SIM110  # all() is not compiled
        if action[c] != planned[c]:
            return False
    return True


@compiled(apart=True)
def try_action(
    world: Members, states: Floats, ended: Bools, step: int, action: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, after: Floats, over: Bools,
) -> tuple[float, float, int]:  # fmt: skip
    """Simulate one step with an action, and search for a plan that continues it within the budget.

    A plan holds one action for each decision. Tried are the rest of the present plan, then the constant actions. An
    action for which the physics fails is not certified.

    Args:
        world: the M possible worlds of one world (``Members``).
        states: [M, S] their states now, in the layout of ``Running.states``.
        ended: [M] whether their episodes have ended.
        step: number of the present decision.
        action: [K] action to try.
        budget: largest accepted harm of the episode, m2/s2.
        certified: harm of ``plan``, m2/s2.
        constants: [C, K] constant actions.
        plan: [L, K] present plan; on success, replaced by the action and the plan behind it.
        room: [2, L, K] workspace.
        after: [M, S] receives the states after the step.
        over: [M] receives whether the episodes have ended then.

    Returns the harm of the plan found, which is a success if it is at most ``budget``; the least harm found; and the
    code of the reason (``ShieldReason``).

    """
    going = take_steps(world, states, ended, step, action, after, over)
    value = worst_so_far(world, after) if going >= 0 else math.inf
    reason, least = PLAN_REMAINS, value
    if is_planned(action, plan[step]) and going >= 0:
        reason, value = SAME_AS_PLAN, certified
    elif going > 0:
        for j in range(plan.shape[0]):
            copy_action(plan[j], room[0, j])
        value = worst_of_plan(world, after, over, step + 1, plan, budget)
        reason = CONSTANT if value > budget else PLAN_REMAINS
        value, least = better_plan(world, after, over, step + 1, constants, value, budget, room[0], room[1])
        if value <= budget:
            for j in range(plan.shape[0]):
                copy_action(room[0, j], plan[j])
    if value <= budget:
        copy_action(action, plan[step])
    return value, least, reason


@compiled
def tell_action(out: Floats, action: Floats, bound: float, margin: float) -> None:
    """Write the applied action, bound and margin of each shielded vehicle into its row of ``out`` [K, 4].

    ``out`` has the columns ``APPLIED``, ``REASON``, ``BOUND`` and ``MARGIN``; its reasons are filled in before. A
    vehicle whose proposal was rejected keeps the margin that is in ``out`` already.

    Args:
        out: changed in place.
        action: [K] applied actions.
        bound: harm that is guaranteed from now on, m2/s2.
        margin: budget minus the harm found, m2/s2.

    """
    for c in range(action.shape[0]):
        out[c, APPLIED], out[c, BOUND] = action[c], bound
        if out[c, REASON] != NO_CERTIFICATE:
            out[c, MARGIN] = margin


@compiled(apart=True)
def decide_world(
    world: Members, states: Floats, ended: Bools, step: int, proposed: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, tried: Floats, after: Floats, over: Bools, out: Floats,
) -> bool:  # fmt: skip
    """Decide in one world: accept the proposed actions, or replace them by those of the plan.

    All proposals are tried together first. If they have no certificate, the vehicles are tried one by one, front to
    rear, each beside the actions that the plan holds by then.

    Args:
        world: the M possible worlds of this world (``Members``).
        states: [M, S] their states now, in the layout of ``Running.states``.
        ended: [M] whether their episodes have ended.
        step: number of the present decision.
        proposed: [K] proposed actions; NaN: none.
        budget: largest accepted harm of the episode, m2/s2.
        certified: harm of ``plan``, m2/s2.
        constants: [C, K] constant actions that may replace the rest of a plan.
        plan: [L, K] one action for each decision; changed in place, so that its harm is the bound in ``out``.
        room: [2, L, K] workspace.
        tried: [2, K] workspace.
        after: [M, S] receives the states after the step.
        over: [M] receives whether the episodes have ended then.
        out: [K, 4] receives applied action, reason, bound and margin of each vehicle.

    Returns False if the physics fails with the applied actions.

    """
    deviating = 0
    for c in range(proposed.shape[0]):
        usable = not math.isnan(proposed[c])
        tried[0, c] = min(max(proposed[c], -1.0), 1.0) if usable else plan[step, c]
        out[c, REASON] = SAME_AS_PLAN if usable else NOT_A_NUMBER
        if tried[0, c] != plan[step, c]:
            out[c, REASON] = -1  # not decided yet
            deviating += 1
    value, least, reason = try_action(
        world, states, ended, step, tried[0], budget, certified, constants, plan, room, after, over
    )  # fmt: skip
    if value <= budget:
        for c in range(out.shape[0]):
            out[c, REASON] = reason if out[c, REASON] == -1 else out[c, REASON]
        tell_action(out, plan[step], value, budget - value)
        return True
    bound, accepted = certified, 0
    for c in range(out.shape[0]):
        if out[c, REASON] != -1:
            continue
        if deviating > 1:
            copy_action(plan[step], tried[1])
            tried[1, c] = tried[0, c]
            value, least, reason = try_action(
                world, states, ended, step, tried[1], budget, bound, constants, plan, room, after, over
            )  # fmt: skip
        fits = value <= budget
        out[c, REASON], out[c, MARGIN] = reason if fits else NO_CERTIFICATE, budget - least
        if fits:
            bound, accepted = value, accepted + 1
    going = take_steps(world, states, ended, step, plan[step], after, over)
    if going > 0 and accepted == 0:
        bound, _ = better_plan(world, after, over, step + 1, constants, bound, bound, plan, room[1])
    tell_action(out, plan[step], bound, budget - bound)
    return going >= 0


@compiled
def certify_worlds(
    running: Running, proposed: Floats, budget: Floats, certified: Floats, constants: Floats, plans: Floats,
    after: Floats, out: Floats, over: Bools, failed: Bools,
) -> None:  # fmt: skip
    """Decide in each of n worlds whose episode still runs, by ``decide_world``.

    A world whose episode has ended keeps its state and its plan.

    Args:
        running: the episodes at this decision, n worlds with M possible worlds each.
        proposed: [n, K] proposed actions; NaN: none.
        budget: [n] largest accepted harm of each episode, m2/s2.
        certified: [n] harm of each plan, m2/s2.
        constants: [C, K] constant actions that may replace the rest of a plan.
        plans: [n, L, K] one action for each decision; changed in place.
        after: [n * M, S] receives the states after the step.
        out: [n, K, 4] receives applied action, reason, bound and margin of each vehicle.
        over: [n * M] receives whether the episodes have ended then.
        failed: [n] receives whether the physics failed.

    """
    n, every = running.steps.shape[0], all_members(running)
    room, tried = np.zeros((2, plans.shape[1], plans.shape[2])), np.zeros((2, plans.shape[2]))
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        if running.ended[a:b].all():
            for m in range(a, b):
                copy_action(running.states[m], after[m])
            last = min(running.steps[k], plans.shape[1] - 1)
            for c in range(plans.shape[2]):
                out[k, c, APPLIED], out[k, c, REASON] = plans[k, last, c], ENDED
                out[k, c, BOUND], out[k, c, MARGIN] = certified[k], budget[k] - certified[k]
            over[a:b] = True
            continue
        good = decide_world(
            members_from(every, a, b), running.states[a:b], running.ended[a:b], running.steps[k], proposed[k],
            budget[k], certified[k], constants, plans[k], room, tried, after[a:b], over[a:b], out[k],
        )  # fmt: skip
        failed[k] = not good


@compiled
def harm_of_plans(running: Running, constants: Floats, plans: Floats, value: Floats) -> None:
    """Write the harm of each plan, executed from now on, to ``value`` [n] m2/s2; infinity if the physics fails.

    The harm is that of the whole episode in the worst possible world. If one of the ``constants`` [C, K] (constant
    actions) harms less than a plan, it first replaces the rest of that plan in ``plans`` [n, L, K].
    """
    n, every = running.steps.shape[0], all_members(running)
    trial = np.zeros((plans.shape[1], plans.shape[2]))
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        a, b = k * M, k * M + M
        world, step, plan = members_from(every, a, b), running.steps[k], plans[k]
        value[k] = worst_of_plan(world, running.states[a:b], running.ended[a:b], step, plan, math.inf)
        if constants.shape[0] > 0:
            value[k], _ = better_plan(
                world, running.states[a:b], running.ended[a:b], step, constants, value[k], value[k], plan, trial
            )


@compiled
def ends_of_plans(running: Running, plans: Floats, rests: Bools, borne: Floats) -> None:
    """Simulate the ``plans`` [n, L, K] from now on and report how the episodes end.

    A plan holds one action for each decision; ``running`` holds n worlds with M possible worlds each. Writes to
    ``rests`` [n] whether every possible world of a world comes to rest before the horizon and stays at rest, and to
    ``borne`` [n * M, N] the harm that each vehicle bears by then, m2/s2 (an obstacle ahead bears none).
    """
    n, every = running.steps.shape[0], all_members(running)
    M = running.states.shape[0] // max(n, 1)
    for k in range(n):
        rests[k] = True
        for m in range(k * M, k * M + M):
            follow_plan(every, m, running.states[m], running.ended[m], running.steps[k], plans[k], math.inf)
            rests[k] = rests[k] and at_rest(every.table)
            for i in range(borne.shape[1]):
                borne[m, i] = borne_by(every.table, running.problem.clock[m, CLOCK.HARM_IS_TOTAL], i)


@compiled
def descend_constants(running: Running, grid: Floats, rounds: int, action: Floats) -> None:
    """Improve constant actions by coordinate descent over the vehicles.

    Each vehicle's action is replaced in turn by the action of ``grid`` with the least harm, simulated in one segment.

    Args:
        running: the episodes, n worlds with exactly one possible world each.
        grid: [G] actions to try for one vehicle.
        rounds: how often every vehicle has its turn.
        action: [n, K] constant actions, changed in place.

    """
    every, states, ended, steps = all_members(running), running.states, running.ended, running.steps
    for k in range(states.shape[0]):
        least = hold_constant(every, k, states[k], ended[k], steps[k], action, k)
        for turn in range(rounds * action.shape[1]):
            c = turn % action.shape[1]
            best = action[k, c]
            for g in range(grid.shape[0]):
                action[k, c] = grid[g]
                value = hold_constant(every, k, states[k], ended[k], steps[k], action, k)
                if value < least:
                    best, least = grid[g], value
            action[k, c] = best


CONSTANTS = tuple(-k / 10 for k in range(11))  # constant actions that are tried, from coasting to full braking


class Backup(NamedTuple):
    """The plan that the shield executes if it certifies nothing else, for n worlds."""

    plan: Floats  # [n, L], or [n, L, K] for K shielded vehicles: actions, column j for decision j
    harm: Floats  # [n] harm of the episode in the worst possible world if the plan is executed from now on (m2/s2)
    constants: Floats = np.array(CONSTANTS)  # [C] or [C, K] constant actions that may replace the rest of a plan


class Decision(NamedTuple):
    """Result of ``certify`` for n worlds, with K shielded vehicles if there are several."""

    applied: Floats  # [n] or [n, K] actions in [-1, 1]
    intervened: Bools  # [n] or [n, K] whether the proposal was replaced (clipping to [-1, 1] does not count)
    reason: NDArray[np.int64]  # [n] or [n, K] codes of ShieldReason
    bound: Floats  # [n] largest possible harm of the episode from now on (m2/s2)
    margin: Floats  # [n] or [n, K] accepted harm minus least harm found after the proposal (m2/s2); < 0: rejected
    after: Running  # the predicted episodes at the next decision
    backup: Backup  # the plan whose harm is the bound

    @property
    def reason_names(self) -> NDArray[np.str_]:
        """Why each proposal was accepted or replaced, in words such as "no certificate", [n] or [n, K]."""
        texts = [ShieldReason(code).text for code in self.reason.ravel().tolist()]
        return np.array(texts).reshape(self.reason.shape)

    def put(self, rows: Ints, other: Decision, taken: Ints) -> Decision:
        """Return a copy with world ``rows[j]`` of this decision replaced by world ``taken[j]`` of ``other``."""
        columns: dict[str, Any] = {
            name: put(getattr(self, name), rows, getattr(other, name)[taken]) for name in self._fields[:5]
        }
        at, where = self.after.rows_of(rows), other.after.rows_of(taken)
        after = self.after._replace(
            states=put(self.after.states, at, other.after.states[where]),
            ended=put(self.after.ended, at, other.after.ended[where]),
        )
        plan = put(self.backup.plan, rows, other.backup.plan[taken])
        harm = put(self.backup.harm, rows, other.bound[taken])
        return self._replace(**columns, after=after, backup=self.backup._replace(plan=plan, harm=harm))


def plan_harm(running: Running, plan: Floats) -> Floats:
    """Return the harm of the episodes if the plans are executed from now on, [n] m2/s2.

    A plan holds one action for each decision: ``plan`` is [n, L], or [n, L, K] for K vehicles. The harm is that of the
    whole episode in the worst possible world, and equals the engine's to the bit. Caps on the harm of single vehicles
    are ignored.
    """
    return bettered_plan(running, plan, np.zeros(0))[1]


def bettered_plan(running: Running, plan: Floats, constants: Floats) -> tuple[Floats, Floats]:
    """Return each plan, or the best constant action from now on if that harms less, and the harm of the result.

    Args:
        running: n episodes at a decision.
        plan: [n, L] or [n, L, K] one action for each decision.
        constants: [C] or [C, K] constant actions to compare with.

    Returns plans in the shape of ``plan``, and [n] m2/s2, the harm of the whole episode in the worst possible world.

    """
    value = np.empty(running.n)
    _check_plan(running, plan)
    plans = np.array(plan, np.float64, order="C")
    K = len(running.problem.vehicles)
    each = plans.reshape(*plans.shape[:2], K)
    harm_of_plans(running.uncapped, constants.reshape(len(constants), K), each, value)
    _raise_if_any(~np.isfinite(value))
    return plans, value


def from_now(past: Floats, later: Floats | float, steps: Ints) -> Floats:
    """Return plans with the actions of ``past`` before the decision number ``steps`` [n], and of ``later`` from it on.

    A plan holds one action for each decision: ``past`` and the result are [n, L] or [n, L, K]; ``later`` has the same
    shape or is one action.
    """
    past_steps = np.arange(past.shape[1]) < steps[:, np.newaxis]
    return np.where(past_steps if past.ndim == 2 else past_steps[:, :, np.newaxis], past, later)


def certify(running: Running, proposed: Floats, backup: Backup, budget: Floats) -> Decision:
    """Decide in every world: apply the proposed action if it can be certified, else the action of the backup plan.

    A proposal is certified if some plan behind it keeps the harm of the episode within the budget. No argument is
    changed.

    Args:
        running: the episodes at this decision.
        proposed: actions [n] or [n, K]; clipped to [-1, 1] first. NaN is replaced by the planned action.
        backup: the plan to apply if a proposal has no certificate, and its harm.
        budget: largest accepted harm of each episode, [n] m2/s2; at least the backup's harm.

    Raises ``InvalidInput`` for shapes that do not fit or a budget below the backup's harm, and ``PhysicsError`` naming
    the worlds in which the physics fails with the applied action.

    """
    n, problem, vehicles = running.n, running.problem, len(running.problem.vehicles)
    _check_plan(running, backup.plan)
    actions = np.ascontiguousarray(proposed, np.float64)
    shape = (n, *backup.plan.shape[2:])
    if not (actions.shape == shape and backup.harm.shape == budget.shape == (n,)):
        raise InvalidInput(
            f"certify: proposed {actions.shape}, backup's harm {backup.harm.shape}, budget {budget.shape};"
            f" {shape}, and twice ({n},) needed"
        )
    if not (budget >= backup.harm).all():
        raise InvalidInput("certify: a budget is below the backup's harm; nothing could be guaranteed")
    plans, after, out = backup.plan.copy(), np.empty_like(running.states), np.empty((n, vehicles, 4))
    over, failed = np.zeros(problem.n, np.bool_), np.zeros(n, np.bool_)
    certify_worlds(
        running, actions.reshape(n, vehicles), budget, backup.harm,
        backup.constants.reshape(-1, vehicles), plans.reshape(n, plans.shape[1], vehicles), after, out, over, failed,
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


def _check_plan(running: Running, plan: Floats) -> None:
    most = int(running.problem.last_step.max(initial=0))
    vehicles = len(running.problem.vehicles)
    fits = vehicles == 1 if plan.ndim == 2 else plan.shape[2:] == (vehicles,)
    if not fits or plan.shape[0] != running.n or plan.shape[1] < most:
        wanted = f"({running.n}, at least {most}{'' if vehicles == 1 else f', {vehicles}'})"
        raise InvalidInput(f"shield: plan {plan.shape}; {wanted} is needed")
