"""The model in rational numbers: an event simulator that shares nothing with the package.

It works with ``fractions.Fraction`` throughout, so nothing is ever rounded; isotonic regression is done by the min-max
formula, and an obstacle ahead bounds that of the vehicles which touch it above by 0. A contact time is a root of a
quadratic: where the root is rational it is exact; otherwise ``simulate`` raises ``Unexact``, or, when ``bits`` is
given, takes the root to that many significant binary digits (and then keeps every number of the state to so many
digits, lest they grow without end).
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import accumulate, pairwise
from math import isqrt
from typing import Any, NamedTuple

Rationals = tuple[Fraction, ...]
ZERO = Fraction(0)
TOUCH_MPS = Fraction(1e-5)  # closing speeds up to this are a touch
SMALLEST = Fraction(1, 1 << 1075)
PLASTIC_MPS = Fraction(0.05)  # a cluster whose largest closing speed is below this does not bounce


class Unexact(ValueError):
    """The next event is a contact at an irrational time, or a number has left the grid that was asked for."""


@dataclass(frozen=True)
class Line:
    """One world at t = 0 with its constant commands; index 0 is the front vehicle."""

    gaps: Rationals
    speeds: Rationals
    command: Rationals
    latency: Rationals
    mass: Rationals
    limit: Rationals
    restitution: Fraction
    obstacle: Fraction | None = None  # distance to an obstacle ahead


class Hit(NamedTuple):
    """One impact of one pair."""

    time: Fraction
    pair: int  # -1: the front vehicle and the obstacle
    closing: Fraction
    first: bool
    front_change: Fraction
    rear_change: Fraction


class Outcome(NamedTuple):
    """The world at the end, its impacts in order, and which kinds of event happened on the way."""

    gaps: Rationals
    speeds: Rationals
    hits: list[Hit]
    kinds: Counter[str]
    obstacle: Fraction | None


def simulate(line: Line, until: Fraction, *, bits: int | None = None, grid: int | None = None) -> Outcome:
    """Run ``line`` to ``until``, the events at ``until`` included.

    ``grid``: raise ``Unexact`` unless every state on the way is a multiple of 1 / grid.
    """
    return _Run(line, bits, grid).to(until)


class _Run:
    """A run so far: gap ``p`` is between vehicles ``p`` and ``p + 1``, and -1, the last of all lists, the obstacle."""

    def __init__(self, line: Line, bits: int | None, grid: int | None) -> None:
        self.line, self.bits, self.grid, self.time = line, bits, grid, ZERO
        self.n = len(line.speeds)
        self.pairs = range(0 if line.obstacle is None else -1, self.n - 1)
        self.g: list[Any] = [*line.gaps, line.obstacle]
        self.v = [*line.speeds, ZERO]
        self.hit: set[int] = set()
        self.joined = [False] * self.n
        self.kinds: Counter[str] = Counter()
        self.hits: list[Hit] = []

    def to(self, until: Fraction) -> Outcome:
        while True:
            self.impacts()
            self.check_grid([self.time, *(self.g[p] for p in self.pairs), *self.v])
            if self.time >= until:
                return Outcome(tuple(self.g[:-1]), tuple(self.v[:-1]), self.hits, self.kinds, self.g[-1])
            self.step(until)

    def check_grid(self, numbers: list[Fraction]) -> None:
        if self.grid is not None and any(self.grid % x.denominator for x in numbers):
            raise Unexact

    def step(self, until: Fraction) -> None:
        """Move to the next event."""
        a = self.accelerations()
        self.check_grid(a)
        times = [until - self.time, *(onset - self.time for onset in self.line.latency if onset > self.time)]
        times += [time for i in range(self.n) for time in self.speed_times(i, a[i])]
        contacts = {p: found for p in self.pairs if (found := self.contact(p, a)) is not None}
        soonest = min([*times, *(time for time, _ in contacts.values())])
        meets = {p: exact for p, (time, exact) in contacts.items() if time == soonest}
        if self.bits is None and not all(meets.values()):
            raise Unexact
        way = [(v + acceleration * soonest / 2) * soonest for v, acceleration in zip(self.v, a, strict=True)]
        for p in self.pairs:
            self.g[p] = ZERO if p in meets else self.rounded(self.g[p] + way[p] - way[p + 1])
        self.v = [self.rounded(v + acceleration * soonest) for v, acceleration in zip(self.v, a, strict=True)]
        self.time = self.rounded(self.time + soonest)
        self.kinds["touch"] += sum(self.v[p] == self.v[p + 1] for p in meets)
        for i in range(self.n):
            self.kinds["onset"] += self.line.latency[i] == self.time and self.line.command[i] != 0
            self.kinds["standstill"] += self.v[i] == 0 and a[i] != 0
            self.kinds["limit"] += self.line.command[i] > 0 and self.v[i] == self.line.limit[i] and a[i] != 0

    def rounded(self, x: Fraction) -> Fraction:
        return x if self.bits is None else significant(x, self.bits)

    def command(self, i: int) -> Fraction:
        return self.line.command[i] if self.line.latency[i] <= self.time else ZERO

    def speed_times(self, i: int, a: Fraction) -> list[Fraction]:
        """Times to the speeds at which vehicle i's own force changes: 0, and its limit when it drives."""
        targets = [ZERO, self.line.limit[i]] if self.command(i) > 0 else [ZERO]
        return [t for target in targets if a != 0 and (t := (target - self.v[i]) / a) > 0]

    def contact(self, p: int, a: list[Fraction]) -> tuple[Fraction, bool] | None:
        """Time to the contact of pair p, and whether it is exact; None when there is none."""
        g, w, b = self.g[p], self.v[p + 1] - self.v[p], a[p + 1] - a[p]
        square = w * w + 2 * b * g
        if self.joined[p] or square < 0 or (w <= 0 and b <= 0):
            return None
        if g == 0:
            assert w < 0, "an approaching or pressing pair was left apart"
            return -2 * w / b, True
        speed, exact = square_root(square, self.bits or 128)
        return 2 * g / (w + speed), exact

    def runs(self, *, alike: bool) -> Iterator[slice]:
        """The vehicles that touch each other, from front to rear; ``alike``: and move at one speed."""
        head = 0
        for k in range(self.n):
            if k + 1 == self.n or self.g[k] != 0 or (alike and self.v[k] != self.v[k + 1]):
                yield slice(head, k + 1)
                head = k + 1

    def at_obstacle(self, run: slice) -> bool:
        return run.start == 0 and self.g[-1] == 0

    def accelerations(self) -> list[Fraction]:
        """Accelerations of all vehicles, coupled in runs that touch and move alike."""
        low, high = zip(*(self.forces(i) for i in range(self.n)), strict=True)
        a: list[Fraction] = []
        for run in self.runs(alike=True):
            found = regression(self.line.mass[run], low[run], high[run])
            a += [min(value, ZERO) for value in found] if self.at_obstacle(run) and self.v[0] == 0 else found
        a.append(ZERO)
        for p in self.pairs:
            joined = self.g[p] == 0 and self.v[p] == self.v[p + 1] and a[p] == a[p + 1]
            self.kinds["released"] += self.joined[p] and not joined
            self.kinds["joined"] += joined and not self.joined[p]
            pushed = low[p + 1] > 0 and any(lo < 0 < hi for lo, hi in zip(low[: p + 1], high[: p + 1], strict=True))
            self.kinds["held"] += joined and a[p] == 0 and self.v[p] == 0 and pushed
            self.joined[p] = joined
        return a

    def forces(self, i: int) -> tuple[Fraction, Fraction]:
        """Range of vehicle i's own force per mass at its present speed."""
        u, v = self.command(i), self.v[i]
        if u < 0:
            return (u, -u) if v == 0 else (u, u) if v > 0 else (-u, -u)
        limit = self.line.limit[i]
        if u > 0 and v >= limit:
            return (ZERO, u) if v == limit else (ZERO, ZERO)
        return u, u

    def impacts(self) -> None:
        """Resolve all approaching pairs that touch, round after round."""
        while any(self.g[p] == 0 and self.v[p + 1] > self.v[p] for p in self.pairs):
            before = list(self.v)
            for run in self.runs(alike=False):
                self.cluster(run)
            for p in self.pairs:
                closing = before[p + 1] - before[p]
                if self.g[p] == 0 and closing > TOUCH_MPS:
                    changes = self.v[p] - before[p], self.v[p + 1] - before[p + 1]
                    self.hits.append(Hit(self.time, p, closing, p not in self.hit, *changes))
                    self.hit.add(p)
                    self.kinds["bounced back"] += self.v[p + 1] < 0 <= before[p + 1]
                self.kinds["impact" if closing > TOUCH_MPS else "touch"] += self.g[p] == 0 and closing > 0

    def cluster(self, run: slice) -> None:
        v = self.v[run]
        against = self.at_obstacle(run)
        closing = max((b - a for a, b in pairwise([ZERO, *v] if against else v)), default=ZERO)
        if closing <= 0:
            return
        e = self.line.restitution if closing >= PLASTIC_MPS else ZERO
        pooled = regression(self.line.mass[run], v, v)
        pooled = [min(value, ZERO) for value in pooled] if against else pooled
        self.check_grid(pooled)
        self.v[run] = [(1 + e) * p - e * old for p, old in zip(pooled, v, strict=True)]


def square_root(square: Fraction, bits: int) -> tuple[Fraction, bool]:
    """The root and True where it is rational; else the root rounded down to ``bits`` binary places and False."""
    p, q = square.numerator, square.denominator
    top, bottom = isqrt(p), isqrt(q)
    if top * top == p and bottom * bottom == q:
        return Fraction(top, bottom), True
    shift = max(0, bits - (p * q).bit_length() // 2)
    return Fraction(isqrt(p * q << 2 * shift), q << shift), False


def significant(x: Fraction, bits: int) -> Fraction:
    """``x`` to that many significant binary digits; 0 where a double would be 0.

    Two plastic impacts that take turns (a collapse) shrink a gap like 2^-(2^k): there the doubles end the series.
    """
    if abs(x) < SMALLEST:
        return ZERO
    shift = bits - abs(x.numerator).bit_length() + x.denominator.bit_length()
    return Fraction(round(x * (1 << shift)), 1 << shift) if shift >= 0 else x


def regression(mass: Rationals, low: list[Fraction] | Rationals, high: list[Fraction] | Rationals) -> list[Fraction]:
    """Decreasing mass-weighted regression by the min-max formula ``min over i <= k, max over j >= k`` of run means.

    The "mean" of a run whose members range over ``[low, high]`` is the value nearest 0 of the mean range.
    """
    n = len(mass)
    result: list[list[Fraction]] = [[] for _ in range(n)]  # of each k the largest mean of a run from i, for every i
    for i in range(n):
        m = lo = hi = ZERO
        means = []
        for j in range(i, n):
            m, lo, hi = m + mass[j], lo + mass[j] * low[j], hi + mass[j] * high[j]
            means.append((lo if lo > 0 else hi if hi < 0 else ZERO) / m)
        for k, largest in zip(range(n - 1, i - 1, -1), accumulate(reversed(means), max), strict=True):
            result[k].append(largest)
    return [min(each) for each in result]
