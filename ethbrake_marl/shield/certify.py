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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.episode import START, TIME_STEP, decision_s
from ethbrake_marl.search.problem import ProfileProblem
from ethbrake_marl.shield.certify_kernel import NO_CERTIFICATE, NOT_A_NUMBER, certify_worlds, harm_of_plans

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
        return decision_s(clock[:, START], clock[:, TIME_STEP], self.steps)

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
