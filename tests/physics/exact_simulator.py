"""The model in rational numbers: an event simulator that shares nothing with the package.

It works with ``fractions.Fraction`` throughout, so nothing is ever rounded; isotonic regression is done by the min-max
formula, and an obstacle ahead bounds that of the vehicles which touch it above by 0. A contact time is a root of a
quadratic: where the root is rational it is exact; otherwise ``simulate`` raises ``Unexact``, or, when ``bits`` is
given, takes the root to that many significant binary digits (and then keeps every number of the state to so many
digits, lest they grow without end).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from math import inf, isqrt
from typing import NamedTuple

from ethbrake_marl.physics import Worlds

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


@dataclass
class Outcome:
    """The world at the end, its impacts in order, and which kinds of event happened on the way."""

    gaps: Rationals
    speeds: Rationals
    hits: list[Hit] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    obstacle: Fraction | None = None


def line_of(worlds: Worlds, command: list[float], k: int) -> Line:
    """World ``k`` of a batch, exactly."""
    v = worlds.vehicles
    rows = (worlds.gaps_m[k], worlds.speeds_mps[k], command, v.latency_s[k], v.mass_t[k], v.speed_limit_mps[k])
    obstacle = Fraction(float(worlds.obstacle_gap_m[k])) if worlds.obstacle_gap_m[k] < inf else None
    return Line(*(tuple(Fraction(float(x)) for x in row) for row in rows), Fraction(float(v.restitution[k])), obstacle)


def simulate(
    line: Line, until: Fraction, *, start: Fraction = ZERO, bits: int | None = None, grid: int | None = None
) -> Outcome:
    """Run ``line`` from ``start`` to ``until``, the events at ``until`` included.

    ``grid``: raise ``Unexact`` unless every state on the way is a multiple of 1 / grid.
    """
    return _Run(line, start, bits, grid).to(until)


class _Run:
    def __init__(self, line: Line, start: Fraction, bits: int | None, grid: int | None) -> None:
        self.line, self.bits, self.grid, self.time = line, bits, grid, start
        self.n = len(line.speeds)
        self.g = list(line.gaps)
        self.v = list(line.speeds)
        self.h = line.obstacle
        self.leaning = False  # the front vehicle rests against the obstacle
        self.hit: set[int] = set()
        self.joined: list[bool] = [False] * (self.n - 1)
        self.out = Outcome((), ())

    def to(self, until: Fraction) -> Outcome:
        while True:
            self.impacts()
            self.check_grid((self.time, *self.g, *self.v, self.h or ZERO))
            if self.time >= until:
                break
            self.step(until)
        self.out.gaps = tuple(self.g)
        self.out.speeds = tuple(self.v)
        self.out.obstacle = self.h
        return self.out

    def check_grid(self, numbers: Iterable[Fraction]) -> None:
        if self.grid is not None and any(self.grid % x.denominator for x in numbers):
            raise Unexact

    def step(self, until: Fraction) -> None:
        """Move to the next event."""
        a = self.accelerations()
        self.check_grid(a)
        soonest = until - self.time
        for i in range(self.n):
            if self.line.latency[i] > self.time:
                soonest = min(soonest, self.line.latency[i] - self.time)
            soonest = min([soonest, *self.speed_times(i, a[i])])
        ahead = range(0 if self.h is None else -1, self.n - 1)
        contacts = {p: found for p in ahead if (found := self.contact(p, a)) is not None}
        first = min((t for t, _ in contacts.values()), default=soonest)
        if first <= soonest and any(t == first and not exact for t, exact in contacts.values()) and self.bits is None:
            raise Unexact
        soonest = min(soonest, first)
        way = [(v + acceleration * soonest / 2) * soonest for v, acceleration in zip(self.v, a, strict=True)]
        meets = [p in contacts and contacts[p][0] == soonest for p in range(self.n - 1)]
        self.g = [ZERO if meets[p] else g + way[p] - way[p + 1] for p, g in enumerate(self.g)]
        if self.h is not None:
            self.h = ZERO if -1 in contacts and contacts[-1][0] == soonest else self.h - way[0]
        self.v = [v + acceleration * soonest for v, acceleration in zip(self.v, a, strict=True)]
        self.time += soonest
        if self.bits is not None:
            self.g, self.v = ([significant(x, self.bits) for x in row] for row in (self.g, self.v))
            self.time = significant(self.time, self.bits)
            self.h = self.h and significant(self.h, self.bits)
        self.out.kinds["touch"] += sum(met and self.v[p] == self.v[p + 1] for p, met in enumerate(meets))
        self.note_events(a)

    def note_events(self, a: list[Fraction]) -> None:
        for i in range(self.n):
            self.out.kinds["onset"] += self.line.latency[i] == self.time and self.line.command[i] != 0
            self.out.kinds["standstill"] += self.v[i] == 0 and a[i] != 0
            self.out.kinds["limit"] += self.line.command[i] > 0 and self.v[i] == self.line.limit[i] and a[i] != 0

    def command(self, i: int) -> Fraction:
        return self.line.command[i] if self.line.latency[i] <= self.time else ZERO

    def speed_times(self, i: int, a: Fraction) -> list[Fraction]:
        """Times to the speeds at which vehicle i's own force changes: 0, and its limit when it drives."""
        targets = [ZERO, self.line.limit[i]] if self.command(i) > 0 else [ZERO]
        return [t for target in targets if a != 0 and (t := (target - self.v[i]) / a) > 0]

    def contact(self, p: int, a: list[Fraction]) -> tuple[Fraction, bool] | None:
        """Time to the contact of pair p (-1: with the obstacle), and whether it is exact; None when there is none."""
        if self.leaning if p < 0 else self.joined[p]:
            return None
        if p < 0:
            g, w, b = self.h or ZERO, self.v[0], a[0]
        else:
            g, w, b = self.g[p], self.v[p + 1] - self.v[p], a[p + 1] - a[p]
        square = w * w + 2 * b * g
        if square < 0 or (w <= 0 and b <= 0):
            return None
        if g == 0:
            assert w < 0, "an approaching or pressing pair was left apart"
            return -2 * w / b, True
        speed, exact = square_root(square, self.bits or 128)
        return 2 * g / (w + speed), exact

    def touching(self, p: int) -> bool:
        return self.h == 0 if p < 0 else self.g[p] == 0

    def speed_ahead(self, p: int, speeds: list[Fraction]) -> Fraction:
        """Speed of the front vehicle of pair p; the obstacle stands."""
        return ZERO if p < 0 else speeds[p]

    def accelerations(self) -> list[Fraction]:
        """Accelerations of all vehicles, coupled in runs that touch and move alike."""
        low, high = zip(*(self.forces(i) for i in range(self.n)), strict=True)
        a: list[Fraction] = []
        head = 0
        for k in range(self.n):
            if k + 1 < self.n and self.touching(k) and self.v[k] == self.v[k + 1]:
                continue
            found = regression(self.line.mass[head : k + 1], low[head : k + 1], high[head : k + 1])
            against = head == 0 and self.touching(-1) and self.v[0] == 0
            a += [min(value, ZERO) for value in found] if against else found
            head = k + 1
        self.leaning = self.touching(-1) and self.v[0] == 0 and a[0] == 0
        self.out.kinds["leaning"] += self.leaning
        for p in range(self.n - 1):
            together = self.touching(p) and self.v[p] == self.v[p + 1]
            joined = together and a[p] == a[p + 1]
            self.out.kinds["released"] += self.joined[p] and not joined
            self.out.kinds["joined"] += joined and not self.joined[p]
            pushed = low[p + 1] > 0 and any(lo < 0 < hi for lo, hi in zip(low[: p + 1], high[: p + 1], strict=True))
            self.out.kinds["held"] += joined and a[p] == 0 and self.v[p] == 0 and pushed
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
        pairs = range(-1, self.n - 1)
        while any(self.touching(p) and self.v[p + 1] > self.speed_ahead(p, self.v) for p in pairs):
            head, before = 0, list(self.v)
            for k in range(self.n):
                if k + 1 < self.n and self.touching(k):
                    continue
                self.cluster(head, k)
                head = k + 1
            for p in pairs:
                self.note_hit(p, before)

    def note_hit(self, p: int, before: list[Fraction]) -> None:
        closing = before[p + 1] - self.speed_ahead(p, before)
        if not self.touching(p) or closing <= 0:
            return
        if closing <= TOUCH_MPS:
            self.out.kinds["touch"] += 1
            return
        front_change = self.speed_ahead(p, self.v) - self.speed_ahead(p, before)
        changes = front_change, self.v[p + 1] - before[p + 1]
        self.out.hits.append(Hit(self.time, p, closing, p not in self.hit, *changes))
        self.hit.add(p)
        self.out.kinds["impact"] += 1
        self.out.kinds["bounced back"] += self.v[p + 1] < 0 <= before[p + 1]

    def cluster(self, first: int, last: int) -> None:
        v = self.v[first : last + 1]
        against = first == 0 and self.touching(-1)
        closing = max((b - a for a, b in pairwise([ZERO, *v] if against else v)), default=ZERO)
        if closing <= 0:
            return
        e = self.line.restitution if closing >= PLASTIC_MPS else ZERO
        pooled = regression(self.line.mass[first : last + 1], v, v)
        pooled = [min(value, ZERO) for value in pooled] if against else pooled
        self.check_grid(pooled)
        self.v[first : last + 1] = [(1 + e) * p - e * old for p, old in zip(pooled, v, strict=True)]


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
    if n == 1:
        return [nearest_to_rest(low[0], high[0])]
    result: list[Fraction | None] = [None] * n
    for i in range(n):
        m = lo = hi = ZERO
        means = []
        for j in range(i, n):
            m, lo, hi = m + mass[j], lo + mass[j] * low[j], hi + mass[j] * high[j]
            means.append(nearest_to_rest(lo, hi) / m)
        largest = means[-1]
        for k in range(n - 1, i - 1, -1):
            largest = max(largest, means[k - i])
            so_far = result[k]
            result[k] = largest if so_far is None else min(so_far, largest)
    return [value for value in result if value is not None]


def nearest_to_rest(low: Fraction, high: Fraction) -> Fraction:
    """The value of ``[low, high]`` nearest 0."""
    return low if low > 0 else high if high < 0 else ZERO
