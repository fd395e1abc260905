"""Apply proposed actions if a plan that begins with them stays within the budget; if not, apply the backup plan.

The *backup* is the shield's present plan. Two plans that begin with the proposed action are simulated: one continues
with the rest of the backup, the other with the constant action that does the least harm. Each plan is simulated in all
possible worlds (members) of a world, with the compiled functions of the module ``members``. The *harm of a plan* is the
harm of the whole episode if the plan is executed from now on, the largest over the possible worlds, m2/s2. The module
``step`` proves that the harm of the episode never exceeds the bound at the alert.

Arguments of the compiled functions, for one world with M possible worlds, K shielded vehicles and L decisions:

- ``world``: parameters of the possible worlds.
- ``states`` [M, S], ``ended`` [M]: their present states, in the layout of ``Running.states``, and whether their
  episodes have ended.
- ``step``: number of the present decision.
- ``constants`` [C, K]: constant actions that may replace the rest of a plan.
- ``plan`` [L, K]: the present plan, with the actions of each decision; changed in place.
- ``budget``, ``certified``: the budget, and the harm of the present plan, m2/s2.
- ``after`` [M, S], ``over`` [M]: receive the states after the step, and whether the episodes have then ended.
- ``out`` [K, 4]: receives each shielded vehicle's applied action, reason, bound and margin.
- ``room`` [2, L, K], ``trial`` [L, K], ``tried`` [2, K]: workspaces for the plans and actions that are tried.

Functions for n worlds take arrays of budgets and harms [n], plans [n, L, K] and results [n, K, 4]; ``after`` and
``over`` then have n * M rows.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.first_edition.physics.episode import CLOCK, at_rest
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints
from ethbrake_marl.first_edition.shields.members import (
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
from ethbrake_marl.first_edition.shields.reasons import (
    CONSTANT,
    ENDED,
    NO_CERTIFICATE,
    NOT_A_NUMBER,
    PLAN_REMAINS,
    SAME_AS_PLAN,
    ShieldReason,
)
from ethbrake_marl.first_edition.shields.running import Running, put

APPLIED, REASON, BOUND, MARGIN = range(4)  # columns of the decision of one vehicle

# A constant action is first simulated in one segment, which may round differently. If its harm exceeds the limit by at
# most this much (m2/s2), it is still simulated exactly, decision by decision.
NEARLY = 1e-9


@compiled(apart=True)
def best_constant(world: Members, states: Floats, ended: Bools, step: int, constants: Floats) -> tuple[int, float]:
    """Return the index (in ``constants``) of the action that does the least harm, and the harm of this action, m2/s2.

    The harm of a constant action is the largest harm over the possible worlds if the action is held from now to the
    horizon. The time until the horizon is simulated as one segment, not decision by decision.
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
    """Replace the rest of a plan by the best constant action if the new harm is below ``value`` and at most ``most``.

    ``value`` is the harm of ``plan``. Actions from decision ``step`` on are replaced. Returns the harm of the resulting
    plan, and the least harm of all plans that were tried, whether accepted or not (both m2/s2).
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
    for c in range(to.shape[0]):
        to[c] = action[c]


@compiled
def is_planned(action: Floats, planned: Floats) -> bool:
    """Return whether the actions ``action`` [K] of all shielded vehicles equal their ``planned`` actions [K]."""
    for c in range(planned.shape[0]):  # noqa: SIM110  # all() is not compiled
        if action[c] != planned[c]:
            return False
    return True


@compiled(apart=True)
def try_action(
    world: Members, states: Floats, ended: Bools, step: int, action: Floats, budget: float, certified: float,
    constants: Floats, plan: Floats, room: Floats, after: Floats, over: Bools,
) -> tuple[float, float, int]:  # fmt: skip
    """Simulate one step with ``action`` [K]; then search for a plan after this step that stays within the budget.

    The plan that is tried first continues after ``action`` with the rest of the present plan; the other plans continue
    after ``action`` with a constant action. An action for which the physics fails is not certified.

    Returns the harm of the resulting plan, the least harm of all plans that were tried (both m2/s2), and the reason (a
    code of ``ShieldReason``). The search has succeeded if the harm of the resulting plan is at most ``budget``;
    ``plan`` is then the resulting plan, which begins with ``action``.
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
    """Write the applied actions ``action`` [K], ``bound`` and ``margin`` (m2/s2) into ``out``.

    ``margin`` is the budget minus the harm of the plan after this decision. If a vehicle's proposal was rejected, the
    vehicle's margin in ``out`` does not change. The caller must already have written the column ``REASON``.
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
    """Decide in one world: accept the proposed actions, or replace them by the actions of the plan.

    First the proposals of all vehicles are tried together. If no plan after all proposals together stays within the
    budget, the proposals are tried one by one, front to rear, while the other vehicles act as planned. An accepted
    proposal becomes part of the plan before the next vehicle's proposal is tried.

    ``proposed`` [K] is NaN for a vehicle without a proposal. The harm of the new plan is written into the column
    ``BOUND`` of ``out``. Returns False if the physics fails with the actions to apply, otherwise True.
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
    """Call ``decide_world`` for each world whose episode has not ended.

    A world whose episode has ended keeps its state and its plan. ``proposed`` [n, K] is NaN for a vehicle without a
    proposal. ``failed`` [n] receives True for each world in which the physics failed.
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
    """Write into ``value`` [n] m2/s2 the harm of each plan in ``plans``; infinite if the physics fails.

    If one of the ``constants``, repeated up to the horizon, does less harm than the rest of a plan, this constant
    action replaces the rest of the plan, and ``value`` contains the harm of the changed plan.
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

    ``rests`` [n] receives True for the worlds in which all vehicles come to rest before the horizon and stay at rest,
    in every possible world. ``borne`` [n * M, N] receives the harm that each vehicle bears in the whole episode, m2/s2
    (0 for an obstacle ahead).
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
    """Improve the vehicles' constant actions ``action`` [n, K] by coordinate descent; ``action`` is changed in place.

    For one vehicle after the other, the vehicle's action is replaced by the action in ``grid`` [G] that does the least
    harm while the other vehicles keep their actions. The descent goes ``rounds`` times over all vehicles. Each world
    must have exactly one possible world. Each tried action is held to the horizon, and the time until the horizon is
    simulated as one segment, not decision by decision.
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
    """The shield's present plans in n worlds. Where a proposal is not accepted, the plan's action is applied."""

    plan: Floats  # [n, L], or [n, L, K] for K shielded vehicles: actions of each decision; entry j is for decision j
    harm: Floats  # [n] harm of each plan (m2/s2)
    constants: Floats = np.array(CONSTANTS)  # [C] or [C, K] constant actions that may replace the rest of a plan


class Decision(NamedTuple):
    """Result of ``certify`` for n worlds and K shielded vehicles; for a single vehicle the axis K is left out."""

    applied: Floats  # [n] or [n, K] actions in [-1, 1]
    intervened: Bools  # [n] or [n, K] whether the proposal was replaced (clipping to [-1, 1] does not count)
    reason: NDArray[np.int64]  # [n] or [n, K] codes of ShieldReason
    bound: Floats  # [n] bound of the episode from now on (m2/s2)
    margin: Floats  # [n] or [n, K] (m2/s2); negative: rejected
    after: Running  # the predicted episodes at the next decision
    backup: Backup  # the plan whose harm is the bound

    @property
    def reason_names(self) -> NDArray[np.str_]:
        """Reason why each proposal was accepted or replaced, in words such as "no certificate", [n] or [n, K]."""
        texts = [ShieldReason(code).text for code in self.reason.ravel().tolist()]
        return np.array(texts).reshape(self.reason.shape)

    def put(self, rows: Ints, other: Decision, taken: Ints) -> Decision:
        """Return a copy of this decision in which world ``rows[j]`` is replaced by world ``taken[j]`` of ``other``."""
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
    """Return the harm of each plan, [n] m2/s2.

    ``plan`` has the shape [n, L], or [n, L, K] for K vehicles. The result equals, to the bit, the harm that the engine
    would count. Caps are ignored.
    """
    return bettered_plan(running, plan, np.zeros(0))[1]


def bettered_plan(running: Running, plan: Floats, constants: Floats) -> tuple[Floats, Floats]:
    """Replace the rest of a plan by the best constant action where that lowers the harm; return plans and harms.

    ``plan`` and the resulting plans are [n, L] or [n, L, K], ``constants`` [C] or [C, K], and the harms [n] m2/s2.
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
    """Return plans with the actions of ``past`` before decision ``steps`` [n], and of ``later`` from this decision on.

    ``past`` and the result are plans, [n, L] or [n, L, K]; ``later`` is a plan of the same shape, or a single action.
    """
    past_steps = np.arange(past.shape[1]) < steps[:, np.newaxis]
    return np.where(past_steps if past.ndim == 2 else past_steps[:, :, np.newaxis], past, later)


def certify(running: Running, proposed: Floats, backup: Backup, budget: Floats) -> Decision:
    """Decide in every world: apply the proposed action if it can be certified, else the action of the backup plan.

    A proposal is certified if a plan that begins with the proposed action stays within the budget. This function does
    not change its arguments.

    Args:
        running: the running episodes at this decision.
        proposed: proposed actions, [n] or [n, K]; clipped to [-1, 1]. NaN is replaced by the planned action.
        backup: the present plans and their harm.
        budget: budget of each world, at least the harm of ``backup``, [n] m2/s2.

    Raises ``InvalidInput`` if the shapes of the arrays do not fit together, or if a budget is below the harm of
    ``backup``. Raises ``PhysicsError``, which names the worlds, if the physics fails with the applied action.

    """
    n, problem, vehicles = running.n, running.problem, len(running.problem.vehicles)
    _check_plan(running, backup.plan)
    actions = np.ascontiguousarray(proposed, np.float64)
    shape = (n, *backup.plan.shape[2:])
    if not (actions.shape == shape and backup.harm.shape == budget.shape == (n,)):
        raise InvalidInput(
            f"certify: the shapes of proposed, backup.harm and budget are {actions.shape}, {backup.harm.shape} and"
            f" {budget.shape}; must be {shape}, ({n},) and ({n},)"
        )
    if not (budget >= backup.harm).all():
        raise InvalidInput("certify: in every world, budget must be at least backup.harm (the harm of the plan)")
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
        raise InvalidInput(f"shield: plan has the shape {plan.shape}; must have the shape {wanted}")
