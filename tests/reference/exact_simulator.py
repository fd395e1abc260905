"""The model in rational numbers: an event simulator that shares nothing with the package.

It works with ``fractions.Fraction``; isotonic regression is done by the min-max formula, and an obstacle ahead bounds
that of the vehicles which touch it above by 0. A contact time is a root of a quadratic, taken to ``BITS`` significant
binary digits, to which every number of the state is rounded, lest they grow without end.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import accumulate, pairwise
from math import isqrt
from typing import Any, NamedTuple

Rationals = tuple[Fraction, ...]
ZERO = Fraction(0)
BITS = 160
TOUCH_MPS = Fraction(1e-5)  # closing speeds up to this are a touch
SMALLEST = Fraction(1, 1 << 1075)
PLASTIC_MPS = Fraction(0.05)  # a cluster whose largest closing speed is below this does not bounce


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
    by_forces: Rationals | None = None  # of each pair that has had an impact: closing speed by forces since it touched
    struck: frozenset[int] = frozenset()  # pairs that have had an impact


class Outcome(NamedTuple):
    """The world at the end, and its impacts in order."""

    gaps: Rationals
    speeds: Rationals
    hits: list[tuple[int, Fraction]]  # pair (-1: the front vehicle and the obstacle), closing speed
    obstacle: Fraction | None
    pushed: list[Fraction]  # m/s that each pair's contact takes up; the last is the obstacle's
    by_forces: Rationals
    passed: list[Fraction]  # m2/s2 that each pair's contact passes on


class Run:
    """A run so far: gap ``p`` is between vehicles ``p`` and ``p + 1``, and -1, the last of all lists, the obstacle."""

    def __init__(self, line: Line) -> None:
        self.line, self.time = line, ZERO
        self.n = len(line.speeds)
        self.pairs = range(0 if line.obstacle is None else -1, self.n - 1)
        self.g: list[Any] = [*line.gaps, line.obstacle]
        self.v = [*line.speeds, ZERO]
        self.joined = [False] * self.n
        self.hits: list[tuple[int, Fraction]] = []
        self.last: dict[int, Fraction] = {}  # pair -> time of its last impact
        self.pushed = [ZERO] * len(self.g)
        self.passed = [ZERO] * len(self.g)
        self.struck, self.by_forces = set(line.struck), list(line.by_forces or self.pushed)

    def to(self, until: Fraction) -> Outcome:
        """Run to ``until``, the events at ``until`` included."""
        while True:
            self.impacts()
            if self.time >= until:
                by_forces = tuple(self.by_forces)
                obstacle = self.g[-1]
                return Outcome(
                    tuple(self.g[:-1]), tuple(self.v[:-1]), self.hits, obstacle, self.pushed, by_forces, self.passed
                )
            self.step(until)

    def step(self, until: Fraction) -> None:
        """Move to the next event."""
        a = self.accelerations()
        times = [until - self.time, *(onset - self.time for onset in self.line.latency if onset > self.time)]
        times += [time for i in range(self.n) for time in self.speed_times(i, a[i])]
        contacts = {p: time for p in self.pairs if (time := self.contact(p, a)) is not None}
        soonest = min([*times, *contacts.values()])
        self.push(a, soonest)
        way = [(v + acceleration * soonest / 2) * soonest for v, acceleration in zip(self.v, a, strict=True)]
        for p in self.pairs:
            self.g[p] = ZERO if contacts.get(p) == soonest else significant(self.g[p] + way[p] - way[p + 1])
        self.v = [significant(v + acceleration * soonest) for v, acceleration in zip(self.v, a, strict=True)]
        for p in self.pairs:
            self.by_forces[p] = significant(self.by_forces[p] + (a[p + 1] - a[p]) * soonest)
        self.time = significant(self.time + soonest)

    def push(self, a: list[Fraction], soonest: Fraction) -> None:
        """Add what contacts take up: accelerations of the two parts alone, at the speeds in the middle of the time."""
        now, self.v = self.v, [v + each * soonest / 2 for v, each in zip(self.v, a, strict=True)]
        ranges = [self.forces(i) for i in range(self.n)]
        self.v = now
        for p in self.pairs:
            if self.joined[p]:
                self.pushed[p] += soonest * (self.behind(p, ranges) - self.ahead(p, ranges))

    def behind(self, p: int, ranges: list[tuple[Fraction, Fraction]]) -> Fraction:
        """Acceleration of the vehicle behind pair p, without what is ahead."""
        end = next((k for k in range(p + 1, self.n - 1) if not self.joined[k]), self.n - 1)
        return max(self.mean(range(p + 1, k + 1), ranges) for k in range(p + 1, end + 1))

    def ahead(self, p: int, ranges: list[tuple[Fraction, Fraction]]) -> Fraction:
        """Acceleration of the vehicle ahead of pair p, without what is behind."""
        start = next((k + 1 for k in range(p - 1, -1, -1) if not self.joined[k]), 0)
        means = [self.mean(range(k, p + 1), ranges) for k in range(start, p + 1)]
        return min([*means, ZERO] if start == 0 and (p == -1 or self.joined[-1]) else means)

    def mean(self, these: range, ranges: list[tuple[Fraction, Fraction]]) -> Fraction:
        low, high = (sum((self.line.mass[i] * ranges[i][end] for i in these), ZERO) for end in (0, 1))
        return (low if low > 0 else high if high < 0 else ZERO) / sum(self.line.mass[i] for i in these)

    def command(self, i: int) -> Fraction:
        return self.line.command[i] if self.line.latency[i] <= self.time else ZERO

    def speed_times(self, i: int, a: Fraction) -> list[Fraction]:
        """Times to the speeds at which vehicle i's own force changes: 0, and its limit when it drives."""
        targets = [ZERO, self.line.limit[i]] if self.command(i) > 0 else [ZERO]
        return [t for target in targets if a != 0 and (t := (target - self.v[i]) / a) > 0]

    def contact(self, p: int, a: list[Fraction]) -> Fraction | None:
        """Time to the contact of pair p; None when there is none."""
        g, w, b = self.g[p], self.v[p + 1] - self.v[p], a[p + 1] - a[p]
        square = w * w + 2 * b * g
        if self.joined[p] or square < 0 or (w <= 0 and b <= 0):
            return None
        if g == 0:
            assert w < 0, "an approaching or pressing pair was left apart"
            return -2 * w / b
        return 2 * g / (w + square_root(square))

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
            self.joined[p] = self.g[p] == 0 and self.v[p] == self.v[p + 1] and a[p] == a[p + 1]
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
        while True:
            for p in self.pairs:
                if self.g[p] == 0 and self.v[p + 1] <= self.v[p]:
                    self.by_forces[p] = self.v[p + 1] - self.v[p]
            if not any(self.g[p] == 0 and self.v[p + 1] > self.v[p] for p in self.pairs):
                return
            before = list(self.v)
            for run in self.runs(alike=False):
                if self.rattles(run) is None:
                    self.pass_on(run)
            waiting = set()  # pairs whose turn in a series comes later
            for run in self.runs(alike=False):
                p = self.rattles(run)
                if p is None:
                    self.cluster(run)
                else:
                    waiting |= {q for q in self.within(run) if q != p}
                    self.cluster(slice(max(p, 0), p + 2), against=p == -1)
            closing = [(p, before[p + 1] - before[p]) for p in self.pairs if self.g[p] == 0 and p not in waiting]
            for p, speed in closing:
                if speed > TOUCH_MPS and p in self.struck and self.by_forces[p] > 0:
                    taken = speed - (self.v[p + 1] - self.v[p])
                    self.pushed[p] += taken * min(self.by_forces[p], speed) / speed
            self.struck |= {p for p, speed in closing if speed > TOUCH_MPS}
            self.hits += [(p, speed) for p, speed in closing if speed > TOUCH_MPS]
            self.last |= {p: self.time for p, speed in closing if speed > TOUCH_MPS}

    def within(self, run: slice) -> range:
        return range(-1 if self.at_obstacle(run) else run.start, run.stop - 1)

    def rattles(self, run: slice) -> int | None:
        """The pair that a series of plastic impacts at this one moment strikes next; None where there is no series."""
        pairs = self.within(run)
        if self.line.restitution != 0 or len(pairs) < 2 or all(self.last.get(p) != self.time for p in pairs):
            return None
        hardest = max(pairs, key=lambda p: self.v[p + 1] - self.v[p])
        return hardest if self.v[hardest + 1] - self.v[hardest] > TOUCH_MPS else None

    def pass_on(self, run: slice) -> None:
        """Add what each contact would take up if its two sides were alone, minus what its own pair closes."""
        now = list(self.v)
        for p in self.within(run):
            self.cluster(slice(run.start, p + 1))
            front, self.v = self.v[p], list(now)
            self.cluster(slice(p + 1, run.stop), against=False)
            rear, self.v = self.v[p + 1], list(now)
            closing = max(now[p + 1] - now[p], ZERO)
            if rear - front > max(closing, TOUCH_MPS):
                self.passed[p] += (rear - front) ** 2 - closing**2

    def cluster(self, run: slice, *, against: bool | None = None) -> None:
        v = self.v[run]
        against = self.at_obstacle(run) if against is None else against
        closing = max((b - a for a, b in pairwise([ZERO, *v] if against else v)), default=ZERO)
        if closing <= 0:
            return
        e = self.line.restitution if closing >= PLASTIC_MPS else ZERO
        pooled = regression(self.line.mass[run], v, v)
        pooled = [min(value, ZERO) for value in pooled] if against else pooled
        self.v[run] = [(1 + e) * p - e * old for p, old in zip(pooled, v, strict=True)]


def square_root(square: Fraction) -> Fraction:
    """The root, rounded down to ``BITS`` binary places unless it is rational."""
    p, q = square.numerator, square.denominator
    top, bottom = isqrt(p), isqrt(q)
    if top * top == p and bottom * bottom == q:
        return Fraction(top, bottom)
    shift = max(0, BITS - (p * q).bit_length() // 2)
    return Fraction(isqrt(p * q << 2 * shift), q << shift)


def significant(x: Fraction) -> Fraction:
    """The number rounded to ``BITS`` significant binary digits."""
    if abs(x) < SMALLEST:
        return ZERO
    shift = BITS - abs(x.numerator).bit_length() + x.denominator.bit_length()
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
