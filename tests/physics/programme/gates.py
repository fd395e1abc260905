"""The gates of the long programme: each measures one figure and has one threshold."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ethbrake_marl.harm import empty_ledger, split
from ethbrake_marl.physics import Bools, Floats, Impacts, Worlds, advance, concatenate
from ethbrake_marl.physics.tolerances import (
    CLUSTER_EPS,
    ENERGY_EPS,
    EPS,
    GAP_M,
    MOMENTUM_EPS,
    RESTITUTION_EPS,
    SPLIT,
    SPLIT_CASCADE,
)
from tests.physics.exact_simulator import line_of, simulate
from tests.physics.manufacture import manufactured, pressed, stored
from tests.physics.measures import energy_rise_eps, momentum_eps, restitution_eps, rounds
from tests.physics.random_worlds import Batch, Draws, driving_lines, touching_lines
from tests.physics.runs import once, split_errors, state_bytes
from tests.physics.segments import Scan, random_segments, scan
from tests.physics.state_hash import GOLDEN, figures
from tests.physics.test_clusters import accelerations, exact_accelerations, law_error_eps
from tests.physics.test_manufactured import at_once, in_steps
from tests.physics.watched import Watched

CHUNK = 200_000


class Figure(NamedTuple):
    """One measured figure; ``small`` tells whether it is good: ``value <= threshold``."""

    value: float
    threshold: float
    of: str  # what it was measured on

    @property
    def good(self) -> bool:
        """Whether the gate passes; NaN does not."""
        return self.value <= self.threshold


GATES: dict[str, Callable[[], Figure]] = {}


def gate(name: str) -> Callable[[Callable[[], Figure]], Callable[[], Figure]]:
    """Enter a function into the programme under a name."""

    def enter(measure: Callable[[], Figure]) -> Callable[[], Figure]:
        GATES[name] = measure
        return measure

    return enter


# ---------------------------------------------------------------- manufactured worlds


@gate("manufactured worlds, not bit for bit")
def manufactured_worlds() -> Figure:
    """Worlds built backwards from contact times: stored ones and fresh ones."""
    cases = stored() + manufactured(9, 2, 1_500) + manufactured(9, 3, 400) + manufactured(9, 4, 100)
    wrong = sum(bool(at_once(case) or in_steps(case)) for case in cases)
    hits = sum(len(case.outcome.hits) for case in cases)
    return Figure(wrong, 0, f"{len(cases)} worlds, {hits} impacts, at once and in steps of 1/8 s")


@gate("resting contact worlds, not bit for bit")
def pressed_worlds() -> Figure:
    """Worlds that touch at the start."""
    cases = [case for N in (2, 3, 4, 5) for case in pressed(11, N, 1_000)]
    return Figure(sum(bool(at_once(case) or in_steps(case)) for case in cases), 0, f"{len(cases)} worlds")


# ---------------------------------------------------------------- invariants of impacts


def impact_batches() -> list[tuple[Worlds, Worlds, Impacts]]:
    """Touching lines of 2 to 50 vehicles before and after their impacts, with mass ratios up to a million."""
    batches = []
    for N in (2, 3, 5, 10, 50):
        for ratio in (1.0, 1e3, 1e6):
            before, command = touching_lines(21, 1_000_000 // N, N, heaviest_ratio=ratio)
            batches.append((before, *advance(before, command, 0.0)))
    return batches


@gate("momentum at impacts [eps of sum m |v|, per round]")
def momentum() -> Figure:
    """Momentum before and after."""
    batches = impact_batches()
    worst = max(float(np.max(momentum_eps(b, a) / rounds(i))) for b, a, i in batches)
    return Figure(worst, MOMENTUM_EPS, f"{sum(int(i.count.sum()) for *_, i in batches):,} impacts, N = 2 to 50")


@gate("energy rise at impacts [eps of the energy, per round]")
def energy() -> Figure:
    """Kinetic energy over ground."""
    worst = max(float(np.max(energy_rise_eps(b, a) / rounds(i))) for b, a, i in impact_batches())
    return Figure(worst, ENERGY_EPS, "the same impacts")


@gate("restitution of pairs [eps of the larger speed]")
def restitution() -> Figure:
    """Separation speed against e times closing speed."""
    worst, pairs = 0.0, 0
    for key in range(5):
        before, command = touching_lines(30 + key, 1_000_000, 2, heaviest_ratio=10.0**key)
        after, impacts = advance(before, command, 0.0)
        worst, pairs = max(worst, float(restitution_eps(before, after).max())), pairs + int(impacts.count.sum())
    return Figure(worst, RESTITUTION_EPS, f"{pairs:,} impacts of two vehicles")


# ---------------------------------------------------------------- invariants of the motion


@gate("gap against its closed form, and below 0 [m]")
def gaps() -> Figure:
    """Stored gaps against those that follow from the speeds."""
    runs = [Watched(41 + N, 3_000 // N, N, drive=drive) for N in (2, 3, 5, 10) for drive in (False, True)]
    return Figure(max(run.worst for run in runs), GAP_M, f"{sum(run.checked for run in runs):,} steady steps")


@gate("speeds below 0 that no bounce-back explains")
def negative_speeds() -> Figure:
    """Braking lines in short steps."""
    runs = [Watched(51 + N, 3_000 // N, N, drive=False) for N in (2, 3, 5, 10)]
    seen = sum(int((state.speeds_mps < 0).sum()) for run in runs for state in run.states)
    return Figure(sum(run.unexplained_negative_speeds() for run in runs), 0, f"{seen:,} negative speeds seen")


@gate("steps in which energy rose though nobody drives")
def energy_in_motion() -> Figure:
    """Braking lines in short steps."""
    runs = [Watched(51 + N, 3_000 // N, N, drive=False) for N in (2, 3, 5, 10)]
    return Figure(sum(run.energy_rises() for run in runs), 0, f"{len(runs) * 300:,} steps of {3_000:,} vehicles")


@gate("harm shares that do not add up to the last bit")
def shares() -> Figure:
    """Random harm and masses."""
    draws, n = Draws(61), 2_000_000
    harm, mass = draws.uniform(0.0, 2_000.0, (n, 1)), 10.0 ** draws.uniform(-2.0, 4.0, (n, 2))
    both = split(harm, mass)
    rest = harm[:, 0] - both.max(axis=1)  # exact: the larger share is at least half
    return Figure(int(np.sum(rest != both.min(axis=1))), 0, f"{n:,} impacts")


@gate("worlds whose ledger is not the sum of its rows")
def ledger() -> Figure:
    """First-impact and total harm, to the last bit, over three segments."""
    wrong, impacts_seen = 0, 0
    for N in (2, 3, 6, 20):
        worlds, command = driving_lines(62, 60_000 // N, N)
        book, first, total = empty_ledger(worlds), np.zeros(worlds.gaps_m.shape), np.zeros(worlds.gaps_m.shape)
        for until in (0.7, 2.0, 6.0):
            worlds, impacts = advance(worlds, command, until_s=until, record=True)
            book, rows = book.add(impacts), impacts.rows
            assert rows is not None
            segment = np.zeros((2, *first.shape))
            harm = rows.closing_speed_mps * rows.closing_speed_mps
            np.add.at(segment[0], (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
            np.add.at(segment[1], (rows.world, rows.pair), harm)
            first, total, impacts_seen = first + segment[0], total + segment[1], impacts_seen + rows.world.size
        same = (first == book.first_impact_harm) & (total == book.total_harm)
        wrong += int((~same).any(axis=1).sum())
    return Figure(wrong, 0, f"{impacts_seen:,} impacts")


# ---------------------------------------------------------------- completeness

SEGMENTS = {2: 10_000_000, 3: 1_000_000, 5: 500_000}
_SCANS: list[Scan] = []


def scans() -> list[Scan]:
    """The scans of all random segments; made once."""
    if not _SCANS:
        for N, n in SEGMENTS.items():
            rng = np.random.default_rng([71, N])
            _SCANS.extend(scan(random_segments(rng, CHUNK, N)) for _ in range(n // CHUNK))
    return _SCANS


@gate("contacts missed")
def missed() -> Figure:
    """Against the smallest value of each gap's closed form; the doubtful ones against exact arithmetic."""
    found = scans()
    return Figure(
        sum(s.missed.size for s in found),
        0,
        f"{sum(s.pairs for s in found):,} random segments of pairs, {sum(s.contacts for s in found):,} with contact,"
        f" {sum(s.in_doubt for s in found):,} decided by exact arithmetic",
    )


@gate("contacts invented")
def phantom() -> Figure:
    """The same scan."""
    return Figure(sum(s.phantom.size for s in scans()), 0, "the same segments")


@gate("contacts or gaps misplaced")
def wrong() -> Figure:
    """The same scan: time and closing speed of the first contact, final gaps and speeds where there is none."""
    return Figure(sum(s.wrong.size for s in scans()), 0, "the same segments")


@gate("share of contacts that rounding decides")
def borderline() -> Figure:
    """Decided otherwise than by exact arithmetic, within the published blur."""
    pairs = sum(s.pairs for s in scans())
    return Figure(sum(s.borderline for s in scans()) / pairs, 1e-6, "the same segments")


# ---------------------------------------------------------------- against exact arithmetic


def _differences() -> tuple[float, int, int, int]:
    """(largest difference, worlds with other impacts, worlds, impacts) of whole runs against the exact simulator."""
    worst, other, total, impacts_seen = 0.0, 0, 0, 0
    for N, n in {2: 3_000, 3: 2_000, 5: 600, 10: 100, 50: 6}.items():
        worlds, command = driving_lines(81, n, N)
        end, impacts = advance(worlds, command, 6.0, record=True)
        rows = impacts.rows
        assert rows is not None
        for k in range(n):
            exact = simulate(line_of(worlds, command[k].tolist(), k), Fraction(6), bits=160)
            mine = rows.world == k
            total, impacts_seen = total + 1, impacts_seen + len(exact.hits)
            if rows.pair[mine].tolist() != [hit.pair for hit in exact.hits]:
                other += 1
                continue
            pairs = [*zip(end.gaps_m[k], exact.gaps, strict=True), *zip(end.speeds_mps[k], exact.speeds, strict=True)]
            pairs += zip(rows.time_s[mine], [hit.time for hit in exact.hits], strict=True)
            pairs += zip(rows.closing_speed_mps[mine], [hit.closing for hit in exact.hits], strict=True)
            worst = max(worst, *(abs(float(x) - float(y)) for x, y in pairs))
    return worst, other, total, impacts_seen


_EXACT: list[tuple[float, int, int, int]] = []


def differences() -> tuple[float, int, int, int]:
    """``_differences``, made once."""
    if not _EXACT:
        _EXACT.append(_differences())
    return _EXACT[0]


@gate("difference from exact runs [m, m/s, s]")
def exact_runs() -> Figure:
    """Every impact's time and closing speed, final gaps and speeds, after up to hundreds of events."""
    worst, _, total, impacts_seen = differences()
    return Figure(worst, 1e-9, f"{total:,} worlds of 2 to 50 vehicles, {impacts_seen:,} impacts")


@gate("share of runs with other impacts than exact ones")
def exact_counts() -> Figure:
    """Only a collapse or a near tie may differ."""
    _, other, total, _ = differences()
    return Figure(other / total, 1e-3, "the same worlds")


@gate("cluster law [eps of the largest speed, per round]")
def clusters() -> Figure:
    """Speeds after simultaneous impacts against the exact law."""
    worst, worlds = 0.0, 0
    for N, n in {2: 3_000, 3: 3_000, 5: 1_500, 10: 400, 20: 150, 50: 30}.items():
        for ratio in (1.0, 1e3):
            before, command = touching_lines(82, n, N, heaviest_ratio=ratio)
            after, impacts = advance(before, command, 0.0)
            per_round = rounds(impacts)
            worst = max(worst, *(law_error_eps(before, after, k, int(per_round[k])) for k in range(n)))
            worlds += n
    return Figure(worst, CLUSTER_EPS, f"{worlds:,} clusters of 2 to 50 vehicles")


@gate("resting contact against exact force ranges [m/s2]")
def resting() -> Figure:
    """Accelerations of touching lines at rest, moving, and at a speed limit."""
    draws, worst, lines = Draws(83), 0.0, 0
    for N in (2, 3, 5, 10, 25, 50):
        for speed in (0.0, 4.0, 8.0):
            for _ in range(150):
                command, mass = draws.uniform(-16.0, 16.0, (N,)), draws.uniform(0.5, 8.0, (N,))
                expected = exact_accelerations(command.tolist(), mass.tolist(), speed)
                worst = max(worst, float(np.abs(accelerations(command, mass, speed) - expected).max()))
                lines += 1
    return Figure(worst, 1e-9, f"{lines:,} lines of 2 to 50 vehicles")


# ---------------------------------------------------------------- what must not matter


_SPLITS: list[tuple[Floats, Bools]] = []


def splits() -> list[tuple[Floats, Bools]]:
    """All split worlds; made once."""
    if not _SPLITS:
        _SPLITS.extend(split_errors(N, 60_000 // N, cuts, 91) for N in (2, 3, 5, 10, 20) for cuts in (2, 7, 80))
    return _SPLITS


@gate("a segment that is split, few impacts [relative]")
def splitting() -> Figure:
    """Gaps, speeds and harm, relative to at least 100 m, 30 m/s, 900 m2/s2; up to 30 impacts."""
    worst = max(float(error[few].max()) for error, few in splits() if few.any())
    return Figure(worst, SPLIT, f"{sum(int(few.sum()) for _, few in splits()):,} worlds in 2, 7 and 80 parts")


@gate("a segment that is split, cascades [relative]")
def splitting_cascades() -> Figure:
    """The same for worlds with more impacts."""
    worst = max(float(error[~few].max()) for error, few in splits() if not few.all())
    return Figure(
        worst, SPLIT_CASCADE, f"{sum(int((~few).sum()) for _, few in splits()):,} worlds with more than 30 impacts"
    )


@gate("worlds changed by the origin of time")
def origin() -> Figure:
    """To the last bit; times on a grid of 2^-20 s."""
    batch = driving_lines(92, 50_000, 4)
    v = batch.worlds.vehicles
    grid = replace(batch.worlds, vehicles=replace(v, latency_s=np.round(v.latency_s * 2**20) / 2**20))
    here, impacts = advance(grid, batch.command, until_s=6.0)
    changed = 0
    for shift in (-0.5, 64.0, 4096.0):
        vehicles = replace(grid.vehicles, latency_s=grid.vehicles.latency_s + shift)
        moved = replace(grid, vehicles=vehicles, time_s=grid.time_s + shift)
        there, same = advance(moved, batch.command, until_s=6.0 + shift)
        columns = (
            (here.gaps_m, there.gaps_m),
            (here.speeds_mps, there.speeds_mps),
            (impacts.total_harm, same.total_harm),
        )
        changed += int(np.any([(a != b).any(axis=1) for a, b in columns], axis=0).sum())
    return Figure(changed, 0, "50,000 worlds, three shifts (positions are not stored: space has no origin)")


@gate("batches whose bits depend on their make-up")
def batches() -> Figure:
    """One world alone, in any order, in one thread or two."""
    n, changed = 20_000, 0
    batch = driving_lines(93, n, 3)
    whole = state_bytes(*once(batch))

    def together(parts: list[tuple[Worlds, Impacts]]) -> tuple[bytes, ...]:
        harm = [np.concatenate([getattr(i, f) for _, i in parts]) for f in ("first_impact_harm", "total_harm", "count")]
        return state_bytes(concatenate([world for world, _ in parts]), Impacts(*harm))

    def chunk(rows: np.ndarray) -> tuple[Worlds, Impacts]:
        return once(Batch(batch.worlds.take(rows), batch.command[rows]))

    changed += together([chunk(np.array([k])) for k in range(n)]) != whole
    with ThreadPoolExecutor(2) as pool:
        changed += together(list(pool.map(chunk, np.array_split(np.arange(n), 64)))) != whole
    for seed in range(10):
        order = np.random.default_rng(seed).permutation(n)
        world, impacts = chunk(order)
        back = np.argsort(order)
        harm = (impacts.first_impact_harm[back], impacts.total_harm[back], impacts.count[back])
        changed += state_bytes(world.take(back), Impacts(*harm)) != whole
    return Figure(changed, 0, f"{n:,} worlds alone, in 64 parts on 2 threads, in 10 orders")


@gate("golden hash of 10,000 worlds, different")
def golden() -> Figure:
    """``tests/golden/physics_worlds.json``."""
    found = figures()
    return Figure(int(found != json.loads(GOLDEN.read_text("utf-8"))), 0, f"sha256 {str(found['sha256'])[:16]}...")


@gate("bounces: total time of a series [relative]")
def bounces() -> Figure:
    """Against the geometric sum of flights, for e from 0.05 to 0.99."""
    worst = 0.0
    for e in np.linspace(0.05, 0.99, 95):
        wall = touching_lines(0, 1, 2).worlds
        wall = replace(wall, speeds_mps=np.array([[0.0, 8.0]]))
        vehicles = replace(wall.vehicles, mass_t=np.array([[2.0**50, 1.0]]), restitution=np.array([e]))
        _, impacts = advance(replace(wall, vehicles=vehicles), [-8.0, 4.0], 2_000.0, record=True)
        closing = [8.0]
        while closing[-1] >= 0.05:
            closing.append(closing[-1] * e)
        flights = sum(2.0 * w / 4.0 for w in closing[1:])
        assert impacts.rows is not None
        if impacts.count[0, 0] != len(closing):
            return Figure(np.nan, 0, f"e = {e}: {impacts.count[0, 0]} impacts instead of {len(closing)}")
        worst = max(worst, abs(float(impacts.rows.time_s[-1]) / flights - 1.0))
    return Figure(worst, 1e4 * EPS, "95 series of up to 506 impacts")
