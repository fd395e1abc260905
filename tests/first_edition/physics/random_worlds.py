"""Random worlds from raw counter-based bits, whole runs of them, and the measured errors of what came out.

The worlds are the same doubles on any machine and with any version of numpy.
"""

from dataclasses import fields, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds, make_worlds
from tests.reference.exact_simulator import Line
from tests.reference.tolerances import ENERGY_EPS, EPS, FEW_IMPACTS

CAPACITY_MPS2 = 8.0


def line(gaps_m: Any, speeds_mps: Any, **settings: Any) -> Worlds:
    """Vehicles of 1 t that act at once and do not bounce, unless the settings say otherwise."""
    usual = {
        "braking_capacity_mps2": 16.0, "driving_capacity_mps2": 16.0, "latency_s": 0.0, "mass_t": 1.0,
        "restitution": 0.0, "speed_limit_mps": 64.0,
    }  # fmt: skip
    return make_worlds(gaps_m, speeds_mps, **{**usual, **settings})


class Batch(NamedTuple):
    """Worlds at t = 0 and their commands [n, N]."""

    worlds: Worlds
    command: Floats


class Draws:
    """Uniform doubles made from the raw 64-bit words of a Philox counter."""

    def __init__(self, key: int) -> None:
        self._words = np.random.Philox(key=key)

    def uniform(self, low: float, high: float, shape: tuple[int, ...]) -> Floats:
        """Multiples of 2^-53 in [0, 1), scaled."""
        words = np.asarray(self._words.random_raw(int(np.prod(shape))), np.uint64).reshape(shape)
        return low + (high - low) * ((words >> np.uint64(11)).astype(np.float64) * 2.0**-53)

    def choice(self, values: list[float], shape: tuple[int, ...]) -> Floats:
        """One of ``values`` each."""
        return np.asarray(values)[self.uniform(0.0, len(values), shape).astype(np.int64)]


def driving_lines(key: int, n: int, N: int, *, drive: bool = True) -> Batch:
    """Lines that brake, coast and (with ``drive``) accelerate, some of them from touching or from rest."""
    draws = Draws(key)
    gaps = draws.uniform(0.2, 10.0, (n, N - 1)) * draws.choice([1.0] * 9 + [0.0], (n, N - 1))
    worlds = make_worlds(
        gaps,
        draws.uniform(5.0, 25.0, (n, N)) * draws.choice([1.0] * 19 + [0.0], (n, N)),
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=draws.uniform(0.0, 1.0, (n, N)),
        mass_t=draws.uniform(1.0, 8.0, (n, N)),
        speed_limit_mps=draws.uniform(25.0, 30.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 0.7], (n,)),
    )
    command = draws.uniform(-CAPACITY_MPS2, 4.0 if drive else 0.0, (n, N)) * draws.choice([1.0] * 7 + [0.0], (n, N))
    return Batch(worlds, command)


def place_ahead(batch: Batch, key: int, low: float = 0.2, high: float = 40.0) -> Batch:
    """The same lines with an obstacle ahead, touching in a tenth of them."""
    draws = Draws(key)
    gap = draws.uniform(low, high, (batch.worlds.n,)) * draws.choice([1.0] * 9 + [0.0], (batch.worlds.n,))
    return Batch(replace(batch.worlds, obstacle_gap_m=gap), batch.command)


def touching_lines(key: int, n: int, N: int, *, heaviest_ratio: float = 1.0) -> Batch:
    """Lines in which most pairs touch, at speeds of their own: many simultaneous impacts at t = 0."""
    draws = Draws(key)
    gaps = draws.choice([0.0, 0.0, 0.0, 1.0], (n, N - 1)) if N > 2 else np.zeros((n, 1))
    mass = draws.uniform(0.5, 8.0, (n, N)) * draws.choice([1.0] * 9 + [heaviest_ratio], (n, N))
    worlds = make_worlds(
        gaps,
        draws.uniform(0.0, 30.0, (n, N)),
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=0.0,
        mass_t=mass,
        restitution=draws.choice([0.0, 0.1, 0.5, 0.9, 1.0], (n,)),
    )
    return Batch(worlds, np.zeros((n, N)))


# ---------------------------------------------------------------- where rounding rules

MOST_ULPS = 3.0


def nearly_joined(key: int, n: int, N: int, *, obstacle: bool = False) -> Worlds:
    """Lines that touch throughout, at one speed but for a few units in the last place, masses from 0.05 to 100 t.

    With an ``obstacle`` they touch that too, and only these units are left of their speeds.
    """
    draws = Draws(key)
    speed = 2.0 ** draws.uniform(-10.0, 5.0, (n, 1))
    ulps = np.rint(draws.uniform(-MOST_ULPS, MOST_ULPS, (n, N))) * np.spacing(speed)
    worlds = make_worlds(
        np.zeros((n, N - 1)),
        speed + ulps,
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=0.0,
        mass_t=10.0 ** draws.uniform(-1.3, 2.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 1.0], (n,)),
    )
    return replace(worlds, speeds_mps=ulps, obstacle_gap_m=np.zeros(n)) if obstacle else worlds


def thrown_lines(key: int, n: int, N: int) -> Batch:
    """Lines of any masses and restitution, late leaders among them, against an obstacle 10 to 40 m ahead."""
    draws = Draws(key)
    capacity = draws.uniform(4.0, 9.0, (n, N))
    worlds = make_worlds(
        draws.uniform(1.0, 5.0, (n, N - 1)) * draws.choice([1.0] * 9 + [0.0], (n, N - 1)),
        draws.uniform(15.0, 30.0, (n, N)),
        braking_capacity_mps2=capacity,
        driving_capacity_mps2=4.0,
        latency_s=draws.uniform(0.0, 1.5, (n, N)),
        mass_t=10.0 ** draws.uniform(-1.3, 2.0, (n, N)),
        restitution=draws.choice([0.0, 0.1, 0.3, 0.6], (n,)),
        obstacle_gap_m=draws.uniform(10.0, 40.0, (n,)),
    )
    return Batch(worlds, np.maximum(draws.uniform(-12.0, 4.0, (n, N)), -capacity))


# ---------------------------------------------------------------- whole runs, in one piece and in several

HORIZON_S = 6.0
HARMS = [f.name for f in fields(Impacts) if f.name != "rows"]


def once(batch: Batch) -> tuple[Worlds, Impacts]:
    """The whole run in one piece, with its list of impacts."""
    return advance(batch.worlds, batch.command, until_s=HORIZON_S, record=True)


def state_bytes(worlds: Worlds, impacts: Impacts) -> tuple[bytes, ...]:
    """Every bit of a result."""
    columns = [getattr(worlds, f.name) for f in fields(worlds)[1:]] + [getattr(impacts, name) for name in HARMS]
    return tuple(column.tobytes() for column in columns)


class Split(NamedTuple):
    """In what a run differs from another one; arrays [n]."""

    error: Floats  # largest change of gaps, speeds and harm, relative to at least 100 m, 30 m/s, 900 m2/s2
    few: Bools  # at most FEW_IMPACTS impacts
    other: Bools  # some pair has another number of impacts


def changed(mine: Worlds, total_harm: Floats, count: Floats, whole: Worlds, impacts: Impacts) -> Split:
    """In what worlds with this harm and so many impacts of each pair differ from whole runs."""
    worst = np.zeros(mine.n)
    parts = ((mine.gaps_m, whole.gaps_m, 100.0), (mine.speeds_mps, whole.speeds_mps, 30.0))
    for one, other, size in (*parts, (total_harm, impacts.total_harm, 900.0)):
        scale = np.maximum(np.abs(other).max(axis=1), size)
        worst = np.maximum(worst, np.abs(one - other).max(axis=1) / scale)
    return Split(worst, impacts.count.sum(axis=1) <= FEW_IMPACTS, (count != impacts.count).any(axis=1))


def split_errors(N: int, n: int, cuts: int, key: int) -> Split:
    """Whole runs against the same runs cut at random times."""
    batch = driving_lines(key, n, N)
    edges = np.sort(np.random.default_rng(cuts).uniform(0.0, HORIZON_S, (cuts, n)), axis=0)
    edges[-1], world, total, count = HORIZON_S, batch.worlds, np.zeros((n, N - 1)), np.zeros((n, N - 1))
    for edge in edges:
        world, part = advance(world, batch.command, until_s=edge)
        total, count = total + part.total_harm, count + part.count
    return changed(world, total, count, *once(batch))


def last_digit_errors(N: int, n: int, key: int) -> Split:
    """The same runs, uncut, against those whose initial gaps have another last digit: what doubles can know at all."""
    batch = driving_lines(key, n, N)
    gaps = batch.worlds.gaps_m
    moved = replace(batch.worlds, gaps_m=np.where(gaps > 0.0, np.nextafter(gaps, np.inf), gaps))
    other, impacts = once(Batch(moved, batch.command))
    return changed(other, impacts.total_harm, impacts.count, *once(batch))


# ---------------------------------------------------------------- measured errors of an impact, in eps

Wide = np.longdouble


def rounds(impacts: Impacts) -> Floats:
    """How many rounds of impacts each world had at one instant, at least 1, [n]."""
    return np.maximum(impacts.count.max(axis=1), 1).astype(np.float64)


def momentum_eps(before: Worlds, after: Worlds) -> Floats:
    """Change of momentum in eps of ``sum m max(|v|, |v+|)``, [n]."""
    mass = before.vehicles.mass_t.astype(Wide)
    change = mass * (after.speeds_mps.astype(Wide) - before.speeds_mps)
    scale = mass * np.maximum(np.abs(before.speeds_mps), np.abs(after.speeds_mps))
    return np.asarray(np.abs(change.sum(axis=1)) / scale.sum(axis=1) / EPS, np.float64)


def energy_rise_eps(before: Worlds, after: Worlds) -> Floats:
    """Rise of kinetic energy (over ground) in eps of the energy before, [n]; negative where energy was lost."""
    mass = before.vehicles.mass_t.astype(Wide)
    was, now = ((mass * worlds.speeds_mps.astype(Wide) ** 2).sum(axis=1) for worlds in (before, after))
    return np.asarray((now - was) / np.where(was > 0, was, 1) / EPS, np.float64)


def restitution_eps(before: Worlds, after: Worlds) -> Floats:
    """Two vehicles: error of the speed at which they separate, in eps of the larger speed, for those that met, [k]."""
    front, rear = before.speeds_mps[:, 0].astype(Wide), before.speeds_mps[:, 1].astype(Wide)
    closing = rear - front
    e = np.where(closing >= BOUND.PLASTIC_SPEED_MPS, before.vehicles.restitution, 0.0)
    separation = after.speeds_mps[:, 0].astype(Wide) - after.speeds_mps[:, 1]
    largest = np.maximum(np.abs(before.speeds_mps).max(axis=1), np.abs(after.speeds_mps).max(axis=1))
    met = (closing > 0) & (before.gaps_m[:, 0] == 0.0)
    return np.asarray((np.abs(separation - e * closing) / largest / EPS)[met], np.float64)


# ---------------------------------------------------------------- a batch in many short steps

STEADY_MPS = 1e-12  # a step is steady when the speed at its middle is this near to the mean of its ends


class Watched:
    """Random lines in steps of two halves.

    ``worst``: largest difference, in steady steps without impacts, between a stored gap and the one that follows from
    the speeds alone (by Simpson's rule, exact there, and never clipped at 0), or its depth below 0. [m]
    """

    def __init__(self, key: int, n: int, N: int, *, drive: bool, steps: int = 300, horizon_s: float = 6.0) -> None:
        self.start, self.command = driving_lines(key, n, N, drive=drive)
        edges, worlds, counts = np.linspace(0.0, horizon_s, 2 * steps + 1), [self.start], []
        for edge in edges[1:]:
            after, impacts = advance(worlds[-1], self.command, until_s=edge)
            worlds.append(after)
            counts.append(impacts.count.sum(axis=1))
        self.states, self.impacts = worlds[::2], np.add(counts[::2], counts[1::2])  # [steps, n]
        gaps, speeds, hit = (np.stack([getattr(w, f) for w in worlds]) for f in ("gaps_m", "speeds_mps", "pair_hit"))
        self.before, middle, self.after, self.hit = speeds[:-1:2], speeds[1::2], speeds[2::2], hit[2::2]
        bend = np.abs(self.before - 2.0 * middle + self.after).max(axis=2)
        steady: Bools = (bend < STEADY_MPS) & (self.impacts == 0)
        mean = (self.before + 4.0 * middle + self.after) / 6.0
        span = (edges[2::2] - edges[:-1:2])[:, None, None]
        unclipped = (gaps[:-1:2] + span * (mean[..., :-1] - mean[..., 1:]))[steady]
        self.worst = max(float(np.abs(unclipped - gaps[2::2][steady]).max()), float(-unclipped.min()))
        self.checked = int(steady.sum())

    def energy_rises(self) -> int:
        """Steps in which the energy of a line that nobody drives rose: by more than ENERGY_EPS for each impact."""
        steps = zip(pairwise(self.states), self.impacts, strict=True)
        return sum(int((energy_rise_eps(a, b) > ENERGY_EPS * np.maximum(k, 1)).sum()) for (a, b), k in steps)

    def unexplained_negative_speeds(self) -> int:
        """Negative speeds that no bounce-back explains, or that brakes do not bring towards 0."""
        apart = np.zeros((*self.impacts.shape, 1), bool)
        struck = np.concatenate([self.hit, apart], axis=2) | np.concatenate([apart, self.hit], axis=2)
        bounced = struck & (self.start.vehicles.restitution[:, None] > 0.0)
        sinking = (self.impacts == 0)[..., None] & (self.after < self.before - STEADY_MPS)
        return int(((self.after < 0.0) & (~bounced | sinking)).sum())


def line_of(worlds: Worlds, command: list[float], k: int) -> Line:
    """World ``k`` of a batch, exactly."""
    v = worlds.vehicles
    rows = (worlds.gaps_m[k], worlds.speeds_mps[k], command, v.latency_s[k], v.mass_t[k], v.speed_limit_mps[k])
    obstacle = Fraction(float(worlds.obstacle_gap_m[k])) if worlds.obstacle_gap_m[k] < np.inf else None
    return Line(*(tuple(Fraction(float(x)) for x in row) for row in rows), Fraction(float(v.restitution[k])), obstacle)
