"""Statements about the package's own code that a solver proves, and planted bugs that must break the proofs.

Every statement is a function that raises ``AssertionError`` if the solver does not prove it. The statements are about
real numbers, for all values that the assumptions allow; rounding is not covered. Compilation must be switched off
(``NUMBA_DISABLE_JIT=1``): then the functions of the package run in Python, with symbols instead of numbers, along every
path of their comparisons. So the proofs are about the code itself.
"""

from __future__ import annotations

import inspect
import itertools
import math
import operator
import os
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial, partialmethod
from itertools import product
from types import ModuleType
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import z3

from ethbrake_marl.first_edition.physics import impact, motion, rows
from ethbrake_marl.first_edition.shields import certify
from tests.programmes import Cases, Given, Told

# ---------------------------------------------------------------- symbolic execution

PATIENCE_MS = 60_000  # time limit of the solver for one question
_PATH: list[Path] = []  # the path that is being run


class Path:
    """One path through a function: its decisions, and the conditions that hold on it."""

    def __init__(self, known: list[Any], decided: list[bool]) -> None:
        self.known = list(known)
        self.decided = decided
        self.next = 0
        self.left: list[list[bool]] = []  # branches to be run later
        self.roots = 0

    def decide(self, condition: Any) -> bool:
        """Return whether a condition holds on this path. If both are possible, store the other branch for later."""
        if self.next < len(self.decided):
            holds = self.decided[self.next]
        else:
            holds = possible([*self.known, condition])
            if holds and possible([*self.known, z3.Not(condition)]):
                self.left.append([*self.decided, False])
            self.decided.append(holds)
        self.next += 1
        self.known.append(condition if holds else z3.Not(condition))
        return holds


class Condition:
    """A comparison of symbols, which is decided when its truth value is asked for."""

    def __init__(self, expression: Any) -> None:
        self.expression = expression

    def __bool__(self) -> bool:
        return _PATH[-1].decide(self.expression)


class Symbol:
    """An unknown real number. Plus infinity is above, and minus infinity below, every symbol."""

    def __init__(self, expression: Any) -> None:
        self.expression = expression

    def _computed(self, how: Callable[[Any, Any], Any], other: Any) -> Any:
        if is_infinite(other) and how in (operator.add, operator.sub):
            return how(0.0, other)
        return Symbol(how(self.expression, exact(other)))

    def _reflected(self, how: Callable[[Any, Any], Any], other: Any) -> Symbol:
        return Symbol(how(exact(other), self.expression))

    def _compared(self, how: Callable[[Any, Any], Any], other: Any) -> Any:
        return how(0.0, other) if is_infinite(other) else Condition(how(self.expression, exact(other)))

    __add__ = partialmethod(_computed, operator.add)
    __sub__ = partialmethod(_computed, operator.sub)
    __mul__ = partialmethod(_computed, operator.mul)
    __truediv__ = partialmethod(_computed, operator.truediv)
    __radd__ = partialmethod(_reflected, operator.add)
    __rsub__ = partialmethod(_reflected, operator.sub)
    __rmul__ = partialmethod(_reflected, operator.mul)
    __rtruediv__ = partialmethod(_reflected, operator.truediv)
    __lt__ = partialmethod(_compared, operator.lt)
    __le__ = partialmethod(_compared, operator.le)
    __gt__ = partialmethod(_compared, operator.gt)
    __ge__ = partialmethod(_compared, operator.ge)
    __eq__ = partialmethod(_compared, operator.eq)
    __ne__ = partialmethod(_compared, operator.ne)

    def __neg__(self) -> Symbol:
        return Symbol(-self.expression)

    __hash__ = None  # type: ignore[assignment]


class SymbolicMath:
    """The functions of ``math`` that the package uses, for symbols."""

    inf, nan = math.inf, math.nan

    @staticmethod
    def sqrt(value: Any) -> Symbol:
        """Return the root: a new symbol, at least 0, whose square is the value."""
        path, square = _PATH[-1], exact(value)
        if not holds_always(path.known, square >= 0):
            raise AssertionError(f"the root of what may be negative: {square}")
        path.roots += 1
        root = z3.Real(f"root_{path.roots}")
        path.known += [root >= 0, root * root == square]
        return Symbol(root)

    @staticmethod
    def isnan(value: Any) -> bool:
        """Return False: a symbol is a number."""
        return not isinstance(value, Symbol) and math.isnan(value)


class Ended(NamedTuple):
    """The end of one path."""

    known: list[Any]
    result: Any


def is_infinite(value: Any) -> bool:
    """Return whether a value is a number and infinite, not a symbol."""
    return isinstance(value, float) and math.isinf(value)


def exact(value: Any) -> Any:
    """Return the expression of a symbol, or the exact value of a number."""
    if isinstance(value, Symbol):
        return value.expression
    if isinstance(value, float | int):
        number = Fraction(value)
        return z3.Q(number.numerator, number.denominator)
    return value


def symbols(names: str) -> list[Symbol]:
    """Return one symbol per name."""
    return [Symbol(z3.Real(name)) for name in names.split()]


def paths(function: Callable[[], Any], known: list[Any]) -> Iterator[Ended]:
    """Yield every path through ``function`` under the conditions ``known``."""
    waiting: list[list[bool]] = [[]]
    while waiting:
        path = Path(known, waiting.pop())
        _PATH.append(path)
        try:
            result = function()
        finally:
            _PATH.pop()
        waiting += path.left
        yield Ended(path.known, result)


def possible(statements: list[Any]) -> bool:
    """Return whether all conditions can hold together. If the solver cannot decide, the answer is True."""
    solver = z3.Solver()
    solver.set("timeout", PATIENCE_MS)
    solver.add(*statements)
    return solver.check() != z3.unsat


def holds_always(known: list[Any], statement: Any) -> bool:
    """Return whether a statement follows from the known conditions; False if the solver cannot decide."""
    return not possible([*known, z3.Not(statement)])


# ---------------------------------------------------------------- statements

Statement = Callable[[], int]  # returns the number of paths
STATEMENTS: dict[str, Statement] = {}

BOUNCING, PLASTIC = 1.0, 0.01  # m/s, closing speeds above and below ``PLASTIC_SPEED_MPS``
DECISIONS = ((0, 3), (2, 3), (2, 1))  # statements about the shield: decisions made, decisions left
TEAM_DECISIONS = ((0, 2), (1, 1))  # the same for two shielded vehicles


def states(text: str) -> Callable[[Statement], Statement]:
    """Register a statement."""
    return partial(STATEMENTS.setdefault, text)


def prove(end: Ended, statement: Any, what: str, *assumed: Any) -> None:
    """Raise ``AssertionError`` unless a statement follows at the end of a path."""
    assert holds_always([*end.known, *assumed], statement), f"not proven: {what}"


@states("contact of a pair: found when the gap closes, never earlier, never missed, with the right closing speed")
def contact() -> int:
    """Check ``motion.contact`` against ``motion.drift``, the gap as a function of time."""
    gap, closing, pressing, when = symbols("gap closing pressing when")
    found = list(_run(motion, lambda: motion.contact(gap, closing, pressing), [exact(gap) >= 0]))
    after = exact(motion.drift(gap, closing, pressing, when))
    for end in found:
        time, speed = end.result
        if isinstance(time, float):
            assert time == math.inf
            prove(end, after >= 0, "never closes", exact(when) >= 0)
            continue
        prove(end, exact(time) >= 0, "not in the past")
        prove(end, exact(motion.drift(gap, closing, pressing, time)) == 0, "the gap is closed then")
        prove(end, after > 0, "it is open before", exact(when) > 0, exact(when) < exact(time))
        prove(end, exact(speed) == exact(closing + pressing * time), "the speed is the one then")
        prove(end, exact(speed) >= 0, "and it approaches")
    return len(found)


@states("a braking vehicle stops after the distance v tau + v^2 / (2 a), and never moves backwards")
def stopping() -> int:
    """Check ``motion.solo_motion`` against the stopping distance."""
    speed, capacity, latency, limit, time = symbols("speed capacity latency limit time")
    known = [exact(speed) >= 0, exact(capacity) > 0, exact(latency) >= 0, exact(time) >= 0, exact(limit) >= 0]
    found = list(_run(motion, lambda: motion.solo_motion(speed, -capacity, latency, limit, time), known))
    whole = exact(speed * latency + speed * speed / (2.0 * capacity))
    for end in found:
        after, way, _ = end.result
        prove(end, exact(after) >= 0, "forwards")
        prove(end, z3.And(exact(way) >= 0, exact(way) <= whole), "no farther than its stopping distance")
        stopped = exact(time) * exact(capacity) >= exact(latency) * exact(capacity) + exact(speed)
        prove(end, z3.And(exact(after) == 0, exact(way) == whole), "then it stands, there", stopped, exact(speed) > 0)
        braking = exact(time - latency) * exact(capacity)
        slower = exact(speed) - z3.If(braking > 0, braking, 0)
        prove(end, exact(after) == slower, "until then it slows down by its capacity", z3.Not(stopped))
    return len(found)


def _cluster(vehicles: int, closing: float) -> tuple[list[Symbol], list[Symbol], Symbol, list[Ended]]:
    """Return masses, speeds, restitution, and every path of an impact of touching vehicles; results are new speeds."""
    mass = symbols(" ".join(f"m{i}" for i in range(vehicles)))
    speed = symbols(" ".join(f"v{i}" for i in range(vehicles)))
    (restitution,) = symbols("e")
    known = [exact(m) > 0 for m in mass] + [exact(restitution) >= 0, exact(restitution) <= 1]

    def resolve() -> list[Symbol]:
        table = np.zeros((rows.ROW.OF_IMPACT, vehicles), dtype=object)
        table[rows.ROW.MASS], table[rows.ROW.SPEED] = mass, speed
        table[rows.ROW.CLOSING, : vehicles - 1] = closing
        impact.resolve_cluster(table, restitution, 0, vehicles - 1)
        return list(table[rows.ROW.SPEED])

    return mass, speed, restitution, list(_run(impact, resolve, known))


def _sum(*columns: list[Symbol]) -> Any:
    """Return the sum over vehicles of the product of these values."""
    return sum(math.prod((exact(x) for x in row), start=exact(1)) for row in zip(*columns, strict=True))


@states("impact of two vehicles: momentum is conserved; they separate with e times the closing speed, as in the paper")
def two() -> int:
    """Check ``impact.resolve_cluster`` for two vehicles against Newton's law."""
    mass, speed, restitution, found = _cluster(2, BOUNCING)
    approaching = exact(speed[1]) > exact(speed[0])
    for end in found:
        after = end.result
        prove(end, _sum(mass, after) == _sum(mass, speed), "momentum")
        parting = exact(after[0] - after[1]) == exact(restitution * (speed[1] - speed[0]))
        prove(end, parting, "restitution", approaching)
        kept = z3.And(exact(after[0]) == exact(speed[0]), exact(after[1]) == exact(speed[1]))
        prove(end, kept, "who does not approach is left alone", z3.Not(approaching))
    return len(found)


@states("impact of two or three vehicles: momentum is conserved, and the energy loss is (1 - e^2) of the plastic loss")
def energy() -> int:
    """Prove the energy as an identity. The inequality follows, because masses are positive and e is at most 1."""
    count = 0
    for vehicles in (2, 3):
        mass, speed, restitution, found = _cluster(vehicles, BOUNCING)
        for end in found:
            after = end.result
            prove(end, _sum(mass, after) == _sum(mass, speed), f"momentum of {vehicles}")
            moved = [(u - v) / (1.0 + restitution) for u, v in zip(after, speed, strict=True)]
            lost = exact(1.0 - restitution * restitution) * _sum(mass, moved, moved)
            prove(end, _sum(mass, speed, speed) - _sum(mass, after, after) == lost, f"energy of {vehicles}")
        count += len(found)
    return count


@states("plastic impact of two or three vehicles: momentum is conserved, and no pair approaches afterwards")
def plastic() -> int:
    """Below the plastic speed no vehicle bounces, and afterwards no vehicle is faster than the vehicle ahead."""
    count = 0
    for vehicles in (2, 3):
        mass, speed, _, found = _cluster(vehicles, PLASTIC)
        for end in found:
            after = end.result
            prove(end, _sum(mass, after) == _sum(mass, speed), f"momentum of {vehicles}")
            for ahead, behind in itertools.pairwise(after):
                prove(end, exact(behind) <= exact(ahead), f"order of {vehicles}")
        count += len(found)
    return count


@states("the acceleration of a free body is the value nearest to zero that its forces allow")
def settling() -> int:
    """Check ``motion.settle`` for any range of forces."""
    low, high, other = symbols("low high other")
    found = list(_run(motion, lambda: motion.settle(low, high), [exact(low) <= exact(high)]))
    for end in found:
        value = exact(end.result)
        prove(end, z3.And(value >= exact(low), value <= exact(high)), "within the range")
        allowed = [exact(other) >= exact(low), exact(other) <= exact(high)]
        prove(end, value * value <= exact(other) * exact(other), "nearest to zero", *allowed)
    return len(found)


class _Line:
    """A world as the shield sees it: the effects of actions and the harm of plans are unknown functions.

    An action is one number per shielded vehicle. With several vehicles, only the last step can end the episode.
    """

    def __init__(self, made: int, left: int, vehicles: int = 1) -> None:
        number = z3.RealSort()
        self.made, self.goes_on = made, vehicles > 1 and left > 1
        self.harm = z3.Function("harm", *[number] * (left * vehicles), number)  # whole episode
        self.so_far = z3.Function("so_far", *[number] * vehicles, number)  # harm after the first action
        self.going = z3.Function("going", *[number] * vehicles, z3.IntSort())  # -1 fails, 0 ends, 1 continues
        self.plan = np.array(  # plan of the whole episode
            [symbols(" ".join(f"plan{k}_{c}" for c in range(vehicles))) for k in range(made + left)], object
        )
        self.proposed = symbols(" ".join(f"proposed{c}" for c in range(vehicles)))
        self.budget, self.certified = symbols("budget certified")
        self.constants = np.array(  # more than any path uses
            [symbols(" ".join(f"constant{k}_{c}" for c in range(vehicles))) for k in range(9)], object
        )
        self.fresh = 0

    def known(self) -> list[Any]:
        """Return the invariant: the plan's harm is certified and within the budget, and its first step works."""
        plan, first = _exact(self.plan[self.made :]), _exact(self.plan[self.made])
        return [
            self.harm(*plan) == exact(self.certified),
            exact(self.certified) <= exact(self.budget),
            exact(self.certified) >= 0,
            self.going(*first) >= 0,
            z3.Implies(self.going(*first) == 0, self.so_far(*first) == exact(self.certified)),
        ]

    def take_steps(self, _: Any, __: Any, ___: Any, step: int, action: Any, after: Any, ____: Any) -> int:
        """Take the step of one action: it fails, ends the episode or continues it. Equal actions have equal effects."""
        assert step == self.made, "a wrong step was taken"
        after[0] = np.array(action, object)
        going = self.going(*_exact(action))
        if self.goes_on:
            return 1
        if Condition(going < 0):
            return -1
        return 0 if Condition(going == 0) else 1

    def worst_so_far(self, _: Any, after: Any) -> Any:
        """Return the harm after the action."""
        return Symbol(self.so_far(*_exact(after[0])))

    def worst_of_plan(self, _: Any, after: Any, __: Any, step: int, plan: Any, most: Any) -> Any:
        """Return the harm of the action followed by the plan; infinite above ``most``."""
        assert step == self.made + 1, "the plan is followed from a wrong step"
        harm = self.harm(*_exact(after[0]), *_exact(plan[step:]))
        if isinstance(most, float) and most == math.inf:
            return Symbol(harm)
        return Symbol(harm) if Condition(harm <= exact(most)) else math.inf

    def best_constant(self, *_: Any) -> tuple[int, Symbol]:
        """Return some constant, and a harm that the search claims for it and that may be wrong."""
        self.fresh += 1
        (least,) = symbols(f"least{self.fresh}")
        return self.fresh - 1, least

    def better_plan(self, *given: Any) -> tuple[Any, Any]:
        """Follow the specification of ``better_plan`` for one vehicle: replace the plan only by a better one."""
        _, after, __, step, constants, value, most, plan, ___ = given
        constant, least = self.best_constant()
        rest = [_exact(constants[constant])] * (len(plan) - step)
        harm = self.harm(*_exact(after[0]), *itertools.chain(*rest))
        within = [harm <= exact(most)] if not is_infinite(most) else []
        if Condition(z3.And(*within, *([] if is_infinite(value) else [harm < exact(value)]))):
            plan[step:] = constants[constant]
            return Symbol(harm), Symbol(harm)
        return value, least


def _exact(actions: Any) -> list[Any]:
    """Return the expressions of these actions."""
    return [exact(each) for each in np.ravel(actions)]


@states("a decision of the step shield: applied action and plan have the bound as harm, and it is within the budget")
def decision() -> int:
    """Prove the induction step for ``decide_world`` and ``better_plan``, with and without a proposal.

    The physics is an unknown function of the actions: equal actions have equal effects. The proof needs nothing else.
    """
    return sum(_decided(_Line(*when), (usable,)) for usable, when in product((True, False), DECISIONS))


@states("a decision about two shielded vehicles: the same statement for the vector of their actions")
def decision_of_two() -> int:
    """Prove ``decide_world`` for two vehicles; ``better_plan`` is replaced by its specification."""
    usable = product((True, False), repeat=2)
    return sum(_decided(_Line(*when, 2), both) for both, when in product(usable, TEAM_DECISIONS))


def _decided(line: _Line, usable: tuple[bool, ...]) -> int:
    """Prove the induction step of a decision, and return the number of paths. ``usable``: who proposes a number."""
    vehicles, made = len(usable), line.made

    def decide() -> tuple[Any, Any, Any]:
        line.fresh = 0
        plan, room = line.plan.copy(), np.zeros((2, *line.plan.shape), object)
        after, out, tried = np.zeros(1, object), np.zeros((vehicles, 4), object), np.zeros((2, vehicles), object)
        proposed = np.array([p if use else math.nan for p, use in zip(line.proposed, usable, strict=True)], object)
        good = certify.decide_world(
            None, None, np.zeros(1, bool), made, proposed, line.budget, line.certified, line.constants, plan, room,
            tried, after, np.zeros(1, bool), out,
        )  # fmt: skip
        return good, plan, out

    found = list(_run(certify, decide, line.known(), line))
    for end in found:
        good, plan, out = end.result
        assert good
        assert not is_infinite(out[0, 2]), "the bound is infinite"
        applied, bound = _exact(out[:, 0]), exact(out[0, 2])
        assert all(exact(each).eq(bound) for each in out[:, 2]), "two vehicles get different bounds"
        prove(end, bound <= exact(line.budget), "the bound is within the budget")
        assert all(a.eq(b) for a, b in zip(_exact(plan[made]), applied, strict=True)), "the plan has another action"
        goes_on = z3.BoolVal(True) if line.goes_on else line.going(*applied) > 0
        rest = _exact(plan[made + 1 :])
        prove(end, line.harm(*applied, *rest) == bound, "the plan that is kept has the bound", goes_on)
        prove(end, line.so_far(*applied) == bound, "so has the harm, if the episode is over", z3.Not(goes_on))
    return len(found)


def _run(module: ModuleType, function: Callable[[], Any], known: list[Any], line: _Line | None = None) -> Any:
    """Yield the paths of a function of ``module``, with symbolic roots, and with ``line`` as the physics."""
    names = ("take_steps", "worst_so_far", "worst_of_plan", "best_constant") if line else ()
    if line and len(line.proposed) > 1:
        names = (*names, "better_plan")
    with mock.patch.multiple(module, math=SymbolicMath, **{name: getattr(line, name) for name in names}):
        yield from paths(function, known)


# ---------------------------------------------------------------- bugs


class Bug(NamedTuple):
    """Planted bug: ``old``, which must occur once in the function, becomes ``new``; then ``breaks`` must fail."""

    module: ModuleType
    function: str
    old: str
    new: str
    breaks: Statement


BUGS = {
    "the earlier root of a contact": Bug(
        motion, "contact", "return (speed - closing) / pressing, speed", "return -closing / pressing, speed",
        contact,
    ),
    "a contact missed where the gap opens first": Bug(
        motion, "contact", "if pressing > 0.0:", "if pressing > 0.0 and gap < 1.0:", contact
    ),
    "the way while nothing is in force is forgotten": Bug(
        motion, "solo_motion", "way = speed * onset", "way = 0.0", stopping
    ),
    "restitution of what moves, not of what is left over": Bug(
        impact, "resolve_cluster", "pooled + bounce * (pooled - table[ROW.SPEED, i])",
        "pooled + bounce * (pooled + table[ROW.SPEED, i])", two,
    ),
    "blocks pooled without their masses": Bug(
        impact, "pool", "table[ROW.BLOCK_LOW, count] / mass", "table[ROW.BLOCK_LOW, count] / 2.0", energy
    ),
    "a plastic impact is not put in order": Bug(
        impact, "resolve_cluster", "bounce = restitution if largest >= BOUND.PLASTIC_SPEED_MPS else 0.0",
        "bounce = restitution", plastic,
    ),
    "the budget may rise": Bug(
        certify, "decide_world", "    if value <= budget:\n        for c in",
        "    if value <= 2.0 * budget:\n        for c in", decision,
    ),
    "later proposals are not certified": Bug(
        certify, "decide_world", "    if value <= budget:\n        for c in",
        "    if value <= budget or step > 0:\n        for c in", decision,
    ),
    "the fallback is the plan's first action": Bug(
        certify, "decide_world", "take_steps(world, states, ended, step, plan[step], after, over)",
        "take_steps(world, states, ended, step, plan[0], after, over)", decision,
    ),
    "the plan is followed from the second decision on": Bug(
        certify, "try_action", "value = worst_of_plan(world, after, over, step + 1,",
        "value = worst_of_plan(world, after, over, 1,", decision,
    ),
    "a constant begins one decision late": Bug(
        certify, "better_plan", "for j in range(step, plan.shape[0]):",
        "for j in range(step + 1, plan.shape[0]):",
        decision,
    ),
    "a vehicle that never moves": Bug(
        motion, "solo_motion", "    way = 0.0\n    steady",
        "    return speed, 0.0, math.nan\n    way = 0.0\n    steady",
        stopping,
    ),
    "half the time": Bug(
        motion, "solo_motion", "    way = 0.0\n    steady", "    duration = duration / 2.0\n    way = 0.0\n    steady",
        stopping,
    ),
    "the plan that was certified with a proposal is not kept": Bug(
        certify, "try_action", "                copy_action(room[0, j], plan[j])", "                pass",
        decision,
    ),
    "a constant counts without being certified": Bug(
        certify, "better_plan", "certified = worst_of_plan(world, states, ended, step, trial, most)",
        "certified = least", decision,
    ),
    "the bound of the plan is told for the proposal": Bug(
        certify, "decide_world", "tell_action(out, plan[step], value, budget - value)",
        "tell_action(out, plan[step], certified, budget - value)", decision,
    ),
    "of two, what was tried last is looked at, not what is applied": Bug(
        certify, "decide_world", "take_steps(world, states, ended, step, plan[step], after, over)",
        "take_steps(world, states, ended, step, tried[1], after, over)", decision_of_two,
    ),
    "the first of two that is accepted keeps the bound from before": Bug(
        certify, "decide_world", "bound, accepted = value, accepted + 1", "accepted = accepted + 1",
        decision_of_two,
    ),
    "a plan for two is written for the first alone": Bug(
        certify, "copy_action", "for c in range(to.shape[0]):", "for c in range(1):", decision_of_two
    ),
}  # fmt: skip


def proven(statement: Statement) -> Told:
    return Told(True, f"proven along {statement()} paths")


def unproven(bug: Bug) -> Told:
    """Check that the statement is no longer proven with the bug."""
    source = inspect.getsource(getattr(bug.module, bug.function))
    times = source.count(bug.old)
    assert times == 1, f"{bug.function}: {bug.old!r} occurs {times} times, not once"
    with mock.patch.object(bug.module, bug.function):
        exec(compile(source.replace(bug.old, bug.new), bug.function, "exec"), vars(bug.module))
        try:
            bug.breaks()
        except AssertionError as error:
            return Told(True, str(error))
    return Told(False, "MISSED: the statement is proven in spite of the bug")


def cases(given: Given) -> Cases:
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        sys.exit("compilation must be switched off: NUMBA_DISABLE_JIT=1")
    for text, statement in STATEMENTS.items():
        yield text, partial(proven, statement)
    for name, bug in BUGS.items():
        yield f"bug: {name}", partial(unproven, bug)
