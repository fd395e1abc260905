"""Random segments of two and more vehicles, and where their gaps first close, from closed form alone.

Up to the first contact of a line every vehicle moves on its own: it coasts, then brakes to standstill or drives to its
limit. A gap is then piecewise quadratic, and the smallest value of each piece tells whether and when the pair meets.
Where that is too close to call in doubles (a graze, a contact at the very end, vehicles that touch at the start), the
world is *in doubt* and goes to the exact simulator.
"""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds, make_worlds
from tests.first_edition.physics.random_worlds import line_of
from tests.reference.exact_simulator import simulate
from tests.reference.tolerances import DISCRIMINANT_EPS, END_EPS, EPS, GAP_M

CAPACITY_MPS2 = 9.0


@dataclass(frozen=True)
class Segments:
    """``n`` worlds at t = 0, their commands and durations."""

    worlds: Worlds
    command: Floats  # [n, N]
    duration: Floats  # [n]


@dataclass(frozen=True)
class Meeting:
    """When each pair [n, P] would first meet if nobody else did; infinite where it does not."""

    time: Floats
    squared: Floats  # closing speed squared there
    least: Floats  # smallest gap up to the end of the segment
    doubt: Bools  # too close to call in doubles


@dataclass(frozen=True)
class Scan:
    """What the comparison of a batch found."""

    pairs: int
    contacts: int
    in_doubt: int
    missed: Ints  # worlds
    phantom: Ints  # worlds
    wrong: Ints  # worlds whose first contact has another time or speed, or whose gaps differ


# ---------------------------------------------------------------- one vehicle on its own


@dataclass(frozen=True)
class Solo:
    """Motion of single vehicles [n, N]: coast until ``onset``, then ``acceleration`` until ``ends``."""

    speed: Floats
    onset: Floats
    ends: Floats
    acceleration: Floats
    final: Floats

    def at(self, time: Floats) -> tuple[Floats, Floats, Floats]:
        """Way, speed, and the acceleration just after ``time`` [n, N]."""
        driven = np.clip(time - self.onset, 0.0, self.ends - self.onset)
        over = np.maximum(time - self.ends, 0.0)
        way = self.speed * np.minimum(time, self.onset) + (self.speed + 0.5 * self.acceleration * driven) * driven
        way = way + np.where(over > 0.0, self.final * over, 0.0)
        speed = np.where(time >= self.ends, self.final, self.speed + self.acceleration * driven)
        return way, speed, np.where((time >= self.onset) & (time < self.ends), self.acceleration, 0.0)


def solo(segments: Segments) -> Solo:
    """The solo motion of every vehicle."""
    v, command = segments.worlds.vehicles, segments.command
    speed = segments.worlds.speeds_mps
    idle = (command == 0.0) | ((command < 0.0) & (speed == 0.0)) | ((command > 0.0) & (speed >= v.speed_limit_mps))
    acceleration = np.where(idle, 0.0, command)
    final = np.where(idle, speed, np.where(command < 0.0, 0.0, v.speed_limit_mps))
    lasts = np.where(idle, np.inf, (final - speed) / np.where(idle, 1.0, acceleration))
    onset = np.where(idle, 0.0, v.latency_s)
    return Solo(speed, onset, onset + lasts, acceleration, final)


# ---------------------------------------------------------------- pairs


def meetings(segments: Segments) -> Meeting:
    """First contact of every pair, each pair for itself: the first of its pieces in which the gap is closed."""
    motion, gaps = solo(segments), segments.worlds.gaps_m
    end = np.broadcast_to(segments.duration[:, None], gaps.shape)
    sides = [when[:, side] for when in (motion.onset, motion.ends) for side in (slice(None, -1), slice(1, None))]
    marks = np.sort(np.stack([0.0 * gaps, end, *(np.clip(side, 0.0, end) for side in sides)]), axis=0)
    begin, finish, length = marks[:-1], marks[1:], np.diff(marks, axis=0)  # of the pieces of constant accelerations
    fastest = np.maximum(motion.speed, motion.final)
    fastest = np.maximum(fastest[:, :-1], fastest[:, 1:]) + CAPACITY_MPS2 * EPS
    reach = gaps + fastest * end
    gentle = DISCRIMINANT_EPS * EPS * (fastest**2 + 2.0 * CAPACITY_MPS2 * reach) + BOUND.TOUCH_SPEED_MPS**2
    gap, closing, _ = _gap(motion, gaps, begin)
    last, pressing = _gap(motion, gaps, finish)[0], _gap(motion, gaps, 0.5 * (begin + finish))[2]
    turning = np.divide(closing, -pressing, out=np.full(gap.shape, np.inf), where=pressing < 0.0)
    turns, squared = (closing > 0.0) & (turning < length), closing**2 + 2.0 * pressing * gap
    meets = (length > 0.0) & ((last <= 0.0) | (turns & (squared >= 0.0)))
    still_apart = np.cumsum(meets, axis=0) - meets == 0  # as the piece begins
    meets &= still_apart
    root = np.sqrt(np.maximum(squared, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        passed = np.where(closing > 0.0, 2.0 * gap / (closing + root), (root - closing) / pressing)
    time = np.where(meets, begin + passed, np.inf).min(axis=0)
    lowest = np.where(turns, gap - 0.5 * closing * np.where(turns, turning, 0.0), np.minimum(gap, last))
    grazes = (turns & (np.abs(squared) <= gentle)) | (meets & (squared <= gentle))
    doubt = (still_apart & (length > 0.0) & grazes).any(axis=0)
    doubt |= (np.abs(last[-1]) <= END_EPS * EPS * reach) & ~(time < 0.999 * end)
    doubt |= (gaps == 0.0) & (motion.speed[:, 1:] >= motion.speed[:, :-1])
    return Meeting(
        time, np.where(meets, squared, 0.0).sum(axis=0), np.where(still_apart, lowest, np.inf).min(axis=0), doubt
    )


def _gap(motion: Solo, gaps: Floats, time: Floats) -> tuple[Floats, Floats, Floats]:
    """Gap, closing speed and closing acceleration of every pair just after ``time`` [..., n, P]."""
    front = [x[..., :-1] for x in motion.at(np.concatenate([time, time[..., -1:]], axis=-1))]
    rear = [x[..., 1:] for x in motion.at(np.concatenate([time[..., :1], time], axis=-1))]
    return gaps + (front[0] - rear[0]), rear[1] - front[1], rear[2] - front[2]


# ---------------------------------------------------------------- the comparison


def scan(segments: Segments) -> Scan:
    """Compare the kernel with the closed form, and where that is in doubt with exact arithmetic."""
    meeting, n = meetings(segments), segments.worlds.n
    after, impacts = advance(segments.worlds, segments.command, segments.duration, record=True)
    rows = impacts.rows
    hit_world, first_row = np.unique(rows.world, return_index=True)
    hits = np.isin(np.arange(n), hit_world)
    doubt, expected = meeting.doubt.any(axis=1), np.isfinite(meeting.time).any(axis=1)
    missed, phantom = ~doubt & expected & ~hits, ~doubt & hits & ~expected
    wrong = _wrong_contacts(segments, meeting, rows, hit_world, first_row, ~doubt & expected)
    wrong |= ~doubt & ~expected & ~hits & _wrong_gaps(segments, after)
    columns = np.stack([rows.time_s, rows.pair, rows.closing_speed_mps], axis=1)
    for k in np.flatnonzero(doubt):
        line, until = line_of(segments.worlds, segments.command[k].tolist(), k), Fraction(float(segments.duration[k]))
        exact = [[float(x) for x in hit[:3]] for hit in simulate(line, until, bits=160).hits]
        found = columns[slice(*np.searchsorted(rows.world, [k, k + 1]))]
        missed[k], phantom[k] = len(found) < len(exact), len(found) > len(exact)
        wrong[k] = len(found) == len(exact) and np.any(np.abs(found - np.reshape(exact, (-1, 3))) > 1e-6)
    pairs = n * (segments.worlds.N - 1)
    return Scan(pairs, int(hits.sum()), int(doubt.sum()), *map(np.flatnonzero, (missed, phantom, wrong)))


def _wrong_contacts(
    segments: Segments, meeting: Meeting, rows: ImpactRows, world: Ints, row: Ints, judged: Bools
) -> NDArray[np.bool_]:
    """Worlds whose first recorded contact is not where the closed form puts it."""
    pair = np.argmin(meeting.time, axis=1)
    time = np.min(meeting.time, axis=1)
    squared = np.take_along_axis(meeting.squared, pair[:, None], axis=1)[:, 0]
    v = segments.worlds.speeds_mps.max(axis=1) + CAPACITY_MPS2 * segments.duration
    close = np.sort(meeting.time, axis=1)[:, :2]
    alone = ~(close[:, -1] <= close[:, 0] + 1e-9) if close.shape[1] == 2 else np.ones(pair.size, bool)
    bad, closing = np.zeros(pair.size, bool), rows.closing_speed_mps[row]
    off = np.abs(rows.time_s[row] - time[world]) > 1e-6 * np.minimum(1.0, 1e-2 / np.maximum(closing, 1e-9)) + 1e-9
    off |= np.abs(closing**2 - squared[world]) > 100 * EPS * v[world] ** 2 + 1e-12 * squared[world]
    off |= alone[world] & (rows.pair[row] != pair[world])
    bad[world] = off
    return bad & judged


def _wrong_gaps(segments: Segments, after: Worlds) -> NDArray[np.bool_]:
    """Worlds whose final gaps or speeds differ from the closed form (only for worlds without contact)."""
    motion, gaps, end = solo(segments), segments.worlds.gaps_m, segments.duration[:, None]
    expected, speed = _gap(motion, gaps, np.broadcast_to(end, gaps.shape))[0], motion.at(end)[1]
    return np.any(np.abs(after.gaps_m - expected) > GAP_M, axis=1) | np.any(
        np.abs(after.speeds_mps - speed) > GAP_M, axis=1
    )


# ---------------------------------------------------------------- random segments


def random_segments(rng: np.random.Generator, n: int, N: int) -> Segments:
    """Segments of all kinds: mostly generic or near a graze, some exactly at one, at the end, or from touching."""
    duration = 10.0 ** rng.uniform(-3.0, 0.9, n)
    speeds = rng.uniform(0.0, 30.0, (n, N)) * (rng.random((n, N)) > 0.05)
    alike = rng.random(n) < 0.4
    speeds[alike] = np.abs(speeds[alike, :1] + rng.uniform(-3.0, 3.0, (alike.sum(), N)))
    command = rng.uniform(-CAPACITY_MPS2, CAPACITY_MPS2, (n, N)) * (rng.random((n, N)) > 0.1)
    latency = rng.uniform(-0.3, 1.0, (n, N)) * duration[:, None]
    limit = np.where(rng.random((n, N)) < 0.3, speeds + rng.uniform(0.0, 3.0, (n, N)), 60.0)
    gaps = rng.uniform(0.0, 1.0, (n, N - 1)) * np.maximum(0.02, duration[:, None] * 10.0)
    draft = Segments(_worlds(rng, gaps, speeds, latency, limit), command, duration)
    least = (
        meetings(Segments(_worlds(rng, np.full_like(gaps, 1e6), speeds, latency, limit), command, duration)).least - 1e6
    )
    kind = rng.random(gaps.shape)
    share = 1.0 / (N - 1)
    offset = 10.0 ** rng.uniform(-11.0, -1.0, gaps.shape) * rng.choice([-1.0, 1.0], gaps.shape)
    gaps = np.where(kind < 0.4 * share, np.maximum(-least + offset, 0.0), gaps)
    gaps = np.where(kind < 0.01 * share, np.maximum(-least * (1.0 + rng.integers(-3, 4, gaps.shape) * EPS), 0.0), gaps)
    gaps = np.where(kind < 0.003 * share, 0.0, gaps)
    return Segments(_worlds(rng, gaps, speeds, latency, limit), draft.command, draft.duration)


def _worlds(rng: np.random.Generator, gaps: Floats, speeds: Floats, latency: Floats, limit: Floats) -> Worlds:
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=np.maximum(latency, 0.0),
        mass_t=rng.uniform(1.0, 8.0, speeds.shape),
        speed_limit_mps=np.maximum(limit, 1e-3),
        restitution=rng.choice([0.0, 0.1, 0.5], speeds.shape[0]),
    )
