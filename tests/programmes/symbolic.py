"""Symbolic execution: run a function on symbols, along every path that its comparisons can take.

The function is the package's own, with compilation switched off, so what is proven of it is proven of the code, over
the real numbers. Rounding is not part of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import z3

PATIENCE_MS = 60_000  # of the solver, for one question
_PATH: list[Path] = []  # the one that is being run


class Path:
    """One way through a function: what it has decided, and what is known along it."""

    def __init__(self, known: list[Any], decided: list[bool]) -> None:
        self.known = list(known)
        self.decided = decided
        self.next = 0
        self.left: list[list[bool]] = []  # other ways that branch off here
        self.roots = 0

    def decide(self, condition: Any) -> bool:
        """Whether a condition holds on this path; where both are possible, the other way is kept for later."""
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
    """A comparison of symbols, which decides when it is asked."""

    def __init__(self, expression: Any) -> None:
        self.expression = expression

    def __bool__(self) -> bool:
        return _PATH[-1].decide(self.expression)


class Symbol:
    """A real number that is not known; infinity is above and minus infinity below every one."""

    def __init__(self, expression: Any) -> None:
        self.expression = expression

    def __add__(self, other: Any) -> Any:
        return other if is_infinite(other) else Symbol(self.expression + exact(other))

    def __sub__(self, other: Any) -> Any:
        return -other if is_infinite(other) else Symbol(self.expression - exact(other))

    def __mul__(self, other: Any) -> Symbol:
        return Symbol(self.expression * exact(other))

    def __truediv__(self, other: Any) -> Symbol:
        return Symbol(self.expression / exact(other))

    def __radd__(self, other: Any) -> Symbol:
        return Symbol(exact(other) + self.expression)

    def __rsub__(self, other: Any) -> Symbol:
        return Symbol(exact(other) - self.expression)

    def __rmul__(self, other: Any) -> Symbol:
        return Symbol(exact(other) * self.expression)

    def __rtruediv__(self, other: Any) -> Symbol:
        return Symbol(exact(other) / self.expression)

    def __neg__(self) -> Symbol:
        return Symbol(-self.expression)

    def _compared(self, other: Any, at_infinity: tuple[bool, bool], how: Callable[[Any, Any], Any]) -> Any:
        if is_infinite(other):
            return at_infinity[0] if other > 0 else at_infinity[1]
        return Condition(how(self.expression, exact(other)))

    def __lt__(self, other: Any) -> Any:
        return self._compared(other, (True, False), lambda a, b: a < b)

    def __le__(self, other: Any) -> Any:
        return self._compared(other, (True, False), lambda a, b: a <= b)

    def __gt__(self, other: Any) -> Any:
        return self._compared(other, (False, True), lambda a, b: a > b)

    def __ge__(self, other: Any) -> Any:
        return self._compared(other, (False, True), lambda a, b: a >= b)

    def __eq__(self, other: object) -> Any:
        return self._compared(other, (False, False), lambda a, b: a == b)

    def __ne__(self, other: object) -> Any:
        return self._compared(other, (True, True), lambda a, b: a != b)

    __hash__ = None  # type: ignore[assignment]


class SymbolicMath:
    """What the package's functions ask of ``math``, for symbols."""

    inf, nan = math.inf, math.nan

    @staticmethod
    def sqrt(value: Any) -> Symbol:
        """The root: a new symbol, not negative, whose square is the value, which must not be negative here."""
        path, square = _PATH[-1], exact(value)
        if not holds_always(path.known, square >= 0):
            raise AssertionError(f"the root of what may be negative: {square}")
        path.roots += 1
        root = z3.Real(f"root_{path.roots}")
        path.known += [root >= 0, root * root == square]
        return Symbol(root)

    @staticmethod
    def isnan(value: Any) -> bool:
        """A symbol is a number."""
        return not isinstance(value, Symbol) and math.isnan(value)


class Ended(NamedTuple):
    """The end of one path."""

    known: list[Any]
    result: Any


def is_infinite(value: Any) -> bool:
    """Whether a value is no symbol, and infinite."""
    return isinstance(value, float) and math.isinf(value)


def exact(value: Any) -> Any:
    """A symbol's expression; of a number its exact value."""
    if isinstance(value, Symbol):
        return value.expression
    if isinstance(value, float | int):
        number = Fraction(value)
        return z3.Q(number.numerator, number.denominator)
    return value


def symbols(names: str) -> list[Symbol]:
    """One symbol for each name."""
    return [Symbol(z3.Real(name)) for name in names.split()]


def paths(function: Callable[[], Any], known: list[Any]) -> Iterator[Ended]:
    """Every path through ``function``, under what is ``known`` of its symbols."""
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
    """Whether they can hold together; what the solver cannot tell counts as possible."""
    return _solver(statements).check() != z3.unsat


def holds_always(known: list[Any], statement: Any) -> bool:
    """Whether a statement follows from what is known; what the solver cannot tell does not."""
    return _solver([*known, z3.Not(statement)]).check() == z3.unsat


def _solver(statements: list[Any]) -> Any:
    solver = z3.Solver()
    solver.set("timeout", PATIENCE_MS)
    solver.add(*statements)
    return solver
