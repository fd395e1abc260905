"""Statements about the package's own code that a solver proves, and planted bugs that must break the proofs.

The statements are about real numbers, for all values that the assumptions allow; rounding is not covered. The functions
of the package run in Python, without being compiled, with symbols instead of numbers, along every path of their
comparisons. So the proofs are about the code itself.
"""

from __future__ import annotations

import inspect
import itertools
import math
import operator
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial, partialmethod
from types import ModuleType
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest

from ethbrake_marl.motion import contact as contacts, forces, impact, interval
from ethbrake_marl.motion.layout import CAR_ROWS, CLOSING, LINE_ROWS, MASS, RESTITUTION, SCRATCH_ROWS, SPEED

z3 = pytest.importorskip("z3")
pytestmark = pytest.mark.nightly


@pytest.fixture(autouse=True)
def _uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [each for name, each in sys.modules.items() if name.startswith("ethbrake_marl.motion.")]:
        for name, value in [*vars(module).items()]:
            if hasattr(value, "py_func"):
                monkeypatch.setattr(module, name, value.py_func)
            elif name in ("kernel", "large"):
                monkeypatch.setattr(module, name, lambda function: function)


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
        """Whether a condition holds on this path. If both are possible, store the other branch for later."""
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
        """Root: a new symbol, at least 0, whose square is the value."""
        path, square = _PATH[-1], exact(value)
        if not holds_always(path.known, square >= 0):
            raise AssertionError(f"the root of what may be negative: {square}")
        path.roots += 1
        root = z3.Real(f"root_{path.roots}")
        path.known += [root >= 0, root * root == square]
        return Symbol(root)

    @staticmethod
    def isnan(value: Any) -> bool:
        """False: a symbol is a number."""
        return not isinstance(value, Symbol) and math.isnan(value)


class Ended(NamedTuple):
    """The end of one path."""

    known: list[Any]
    result: Any


def is_infinite(value: Any) -> bool:
    """Whether a value is a number and infinite, not a symbol."""
    return isinstance(value, float) and math.isinf(value)


def exact(value: Any) -> Any:
    """Expression of a symbol, or the exact value of a number."""
    if isinstance(value, Symbol):
        return value.expression
    if isinstance(value, float | int):
        number = Fraction(value)
        return z3.Q(number.numerator, number.denominator)
    return value


def symbols(names: str) -> list[Symbol]:
    """One symbol per name."""
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
    """Whether all conditions can hold together. If the solver cannot decide, the answer is True."""
    solver = z3.Solver()
    solver.set("timeout", PATIENCE_MS)
    solver.add(*statements)
    return solver.check() != z3.unsat


def holds_always(known: list[Any], statement: Any) -> bool:
    """Whether a statement follows from the known conditions; False if the solver cannot decide."""
    return not possible([*known, z3.Not(statement)])


# ---------------------------------------------------------------- statements

Statement = Callable[[], int]  # returns the number of paths
STATEMENTS: dict[str, Statement] = {}

BOUNCING, PLASTIC = 1.0, 0.01  # m/s, closing speeds above and below ``PLASTIC_MPS``


def states(text: str) -> Callable[[Statement], Statement]:
    """Register a statement."""
    return partial(STATEMENTS.setdefault, text)


def prove(end: Ended, statement: Any, what: str, *assumed: Any) -> None:
    """Raise ``AssertionError`` unless a statement follows at the end of a path."""
    assert holds_always([*end.known, *assumed], statement), f"not proven: {what}"


@states("contact of a pair: found when the gap closes, never earlier, never missed, with the right closing speed")
def contact() -> int:
    """Check ``contact`` against ``gap_after``, the gap as a function of time."""
    gap, closing, pressing, when = symbols("gap closing pressing when")
    found = list(_run(contacts, lambda: contacts.contact(gap, closing, pressing), [exact(gap) >= 0]))
    after = exact(contacts.gap_after(gap, closing, pressing, 0.0, when))
    for end in found:
        time, speed = end.result
        if isinstance(time, float):
            assert time == math.inf
            prove(end, after >= 0, "never closes", exact(when) >= 0)
            continue
        prove(end, exact(time) >= 0, "not in the past")
        prove(end, exact(contacts.gap_after(gap, closing, pressing, 0.0, time)) == 0, "the gap is closed then")
        prove(end, after > 0, "it is open before", exact(when) > 0, exact(when) < exact(time))
        prove(end, exact(speed) == exact(closing + pressing * time), "the speed is the one then")
        prove(end, exact(speed) >= 0, "and it approaches")
    return len(found)


@states("a braking vehicle stops after the distance v tau + v^2 / (2 a), and never moves backwards")
def stopping() -> int:
    """Check ``solo`` against the stopping distance."""
    speed, capacity, latency, limit, time = symbols("speed capacity latency limit time")
    known = [exact(speed) >= 0, exact(capacity) > 0, exact(latency) >= 0, exact(time) >= 0, exact(limit) >= 0]
    found = list(_run(interval, lambda: interval.solo(speed, -capacity, latency, limit, time), known))
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
    """Masses, speeds, restitution, and every path of an impact of touching vehicles; results are new speeds."""
    mass = symbols(" ".join(f"m{i}" for i in range(vehicles)))
    speed = symbols(" ".join(f"v{i}" for i in range(vehicles)))
    (restitution,) = symbols("e")
    known = [exact(m) > 0 for m in mass] + [exact(restitution) >= 0, exact(restitution) <= 1]

    def resolve() -> list[Symbol]:
        line, car, scratch = (np.zeros((n, vehicles), dtype=object) for n in (LINE_ROWS, CAR_ROWS, SCRATCH_ROWS))
        car[MASS], car[RESTITUTION], line[SPEED] = mass, restitution, speed
        scratch[CLOSING, : vehicles - 1] = closing
        impact.resolve_cluster(line, car, scratch, 0, vehicles - 1)
        return list(line[SPEED])

    return mass, speed, restitution, list(_run(impact, resolve, known))


def _sum(*columns: list[Symbol]) -> Any:
    """Sum over vehicles of the product of these values."""
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
    """Check ``settle`` for any range of forces whose ends stay."""
    low, high, other = symbols("low high other")
    found = list(_run(forces, lambda: forces.settle(low, high, 0.0, 0.0), [exact(low) <= exact(high)]))
    for end in found:
        value = exact(end.result[0])
        prove(end, z3.And(value >= exact(low), value <= exact(high)), "within the range")
        allowed = [exact(other) >= exact(low), exact(other) <= exact(high)]
        prove(end, value * value <= exact(other) * exact(other), "nearest to zero", *allowed)
    return len(found)


def _run(module: ModuleType, function: Callable[[], Any], known: list[Any]) -> Any:
    """Yield the paths of a function of ``module``, with symbolic roots."""
    with mock.patch.object(module, "math", SymbolicMath):
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
        contacts, "contact", "return (speed - closing) / pressing, speed", "return -closing / pressing, speed", contact
    ),
    "a contact missed where the gap opens first": Bug(
        contacts, "contact", "if pressing > 0.0:", "if pressing > 0.0 and gap < 1.0:", contact
    ),
    "the way while nothing is in force is forgotten": Bug(
        interval, "solo", "way, duration, steady = speed * onset,", "way, duration, steady = 0.0,", stopping
    ),
    "a vehicle that never moves": Bug(
        interval, "solo", "    way, steady = 0.0, command", "    return speed, 0.0, math.nan", stopping
    ),
    "half the time": Bug(
        interval, "solo", "    way, steady = 0.0, command", "    way, steady, duration = 0.0, command, duration / 2.0",
        stopping,
    ),
    "restitution of what moves, not of what is left over": Bug(
        impact, "resolve_cluster", "pooled + bounce * (pooled - line[SPEED, i])",
        "pooled + bounce * (pooled + line[SPEED, i])", two,
    ),
    "blocks pooled without their masses": Bug(
        impact, "pool", "scratch[BLOCK_LOW, count] / block_mass", "scratch[BLOCK_LOW, count] / 2.0", energy
    ),
    "a plastic impact is not put in order": Bug(
        impact, "restitution", "car[RESTITUTION, 0] if closing >= PLASTIC_MPS else 0.0", "car[RESTITUTION, 0]", plastic
    ),
    "the force furthest from zero": Bug(forces, "settle", "return low, low_jerk", "return high, low_jerk", settling),
}  # fmt: skip


@pytest.mark.parametrize("text", STATEMENTS)
def test_statement__is_proven(text: str) -> None:
    print(f"proven along {STATEMENTS[text]()} paths")


@pytest.mark.parametrize("name", BUGS)
def test_statement__is_not_proven_with_a_bug(name: str) -> None:
    bug = BUGS[name]
    source = inspect.getsource(getattr(bug.module, bug.function))
    assert source.count(bug.old) == 1
    with (
        mock.patch.object(bug.module, bug.function),
        pytest.raises(AssertionError, match=r"not proven|the root of what"),
    ):
        exec(compile(source.replace(bug.old, bug.new), str(bug.module.__file__), "exec"), vars(bug.module))
        bug.breaks()
