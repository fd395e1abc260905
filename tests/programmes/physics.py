"""The physics on many worlds: one measured value per check, and its threshold.

The checks of ``tests/physics``, with the tolerances of ``tests/reference/tolerances.py``, on many more worlds.
"""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import cache, partial
from itertools import product
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.first_edition.game.harm import split
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds, make_worlds
from tests.first_edition.physics.manufacture import Case, manufactured, pressed, stored
from tests.first_edition.physics.random_worlds import (
    HARMS,
    HORIZON_S,
    Batch,
    Draws,
    Split,
    Watched,
    driving_lines,
    energy_rise_eps,
    last_digit_errors,
    line_of,
    momentum_eps,
    nearly_joined,
    once,
    place_ahead,
    restitution_eps,
    rounds,
    split_errors,
    state_bytes,
    thrown_lines,
    touching_lines,
)
from tests.first_edition.physics.segments import Scan, random_segments, scan
from tests.first_edition.physics.test_build_up import by_small_steps, played, random_lines, random_pieces
from tests.first_edition.physics.test_one_physics import (
    KINDS,
    advanced,
    disagreeing,
    first_harm_error,
    random_lines as random_lines_of_all,
)
from tests.first_edition.physics.test_oracles import (
    accelerations,
    at_once,
    exact_accelerations,
    in_steps,
    law_error_eps,
)
from tests.golden.test_golden import GOLDEN, figures
from tests.programmes import Cases, Given, Told
from tests.reference.exact_simulator import simulate
from tests.reference.tolerances import (
    BOUNCE_SERIES_EPS,
    CLUSTER_EPS,
    ENERGY_EPS,
    EPS,
    EXACT_RUN,
    GAP_M,
    MOMENTUM_EPS,
    RESTING_MPS2,
    RESTITUTION_EPS,
    SPLIT,
    SPLIT_CASCADE,
)
from tests.test_harm import booked


class Figure(NamedTuple):
    """A measured value. It is good if it is at most the threshold; NaN is not."""

    value: float
    threshold: float
    of: str  # description of the worlds


def measured(measure: Callable[[], Figure]) -> Told:
    value, threshold, of = measure()
    return Told(value <= threshold, f"{value:.3g} <= {threshold:.3g}, {of}")


OPTIONS = {
    "--small-step-worlds": {"type": int, "default": 10_000, "help": "worlds of 'brakes that build up'"},
    "--one-physics-worlds": {"type": int, "default": 10_000, "help": "worlds of 'one physics'"},
}


def cases(given: Given) -> Cases:
    for name, measure in GATES.items():
        yield name, partial(measured, measure)
    each = max(1, given.small_step_worlds // 16)
    for N, obstacle, in_pieces in product((2, 3, 5, 8), (False, True), (False, True)):
        told = f"brakes that build up, N = {N}{', obstacle' * obstacle}{', in pieces' * in_pieces}"
        yield told, partial(measured, partial(small_steps, N, obstacle, in_pieces, each))
    for kind in KINDS:
        N, learners, obstacle, in_pieces = kind
        told = f"one physics, N = {N}, {len(learners)} decide{', obstacle' * obstacle}{', in pieces' * in_pieces}"
        yield told, partial(measured, partial(one_physics, kind, max(1, given.one_physics_worlds // len(KINDS))))


# ---------------------------------------------------------------- brakes that build up


def small_steps(N: int, obstacle: bool, in_pieces: bool, worlds: int) -> Figure:
    """Return the largest relative difference from a simulation in steps of 1e-5 s, or finer steps down to 1e-8 s.

    If two bounces fall into one step, their order and the rest of the cascade can change. Worlds with more than 30
    impacts are not compared.
    """
    key = 100 + 2 * N + obstacle + 50 * in_pieces
    given, commands = random_lines(key, worlds, N, obstacle=obstacle)
    given["latency_s"] = np.round(given["latency_s"], 3) if in_pieces else given["latency_s"]
    pieces = random_pieces(key, given) if in_pieces else {}
    after, harm, impacts = played(make_worlds(**given).play_pieces(pieces), commands)
    exact = np.concatenate([after.gaps_m, after.speeds_mps, after.command_mps2, harm], axis=1)

    def error(rows: Ints, step_s: float) -> Floats:
        some = {key: value[rows] for key, value in given.items()}
        found = np.concatenate(by_small_steps(some, [each[rows] for each in commands], step_s, pieces)[:4], axis=1)
        return np.asarray((np.abs(found - exact[rows]) / (1.0 + np.abs(exact[rows]))).max(axis=1))

    rows = np.flatnonzero(impacts <= 30)
    found, step_s, coarse = error(rows, 1e-5), 1e-5, []
    while (far := found > 2e-3).any() and step_s > 2e-8:
        step_s, coarse = step_s / 10.0, [*coarse, int(far.sum())]
        found[far] = error(rows[far], step_s)
    finer = ", ".join(f"{count} by 1e-{6 + k} s" for k, count in enumerate(coarse)) or "none by finer steps"
    return Figure(float(found.max()), 2e-3, f"{len(rows):,} of {worlds:,} worlds, {finer}")


def one_physics(kind: tuple[int, tuple[int, ...], bool, bool], worlds: int) -> Figure:
    """Return the largest error of first-impact harm from small steps; infinite if engine, search and shield differ.

    As in ``small_steps``, worlds with more than thirty impacts are not compared with small steps.
    """
    N, learners, obstacle, in_pieces = kind
    lines = random_lines_of_all(7, worlds, N, learners, obstacle=obstacle, in_pieces=in_pieces)
    different = len(disagreeing(lines))
    ledger = advanced(lines)[1]
    step_s, rows = 1e-4, np.flatnonzero(ledger.count.sum(axis=1) + ledger.obstacle_count <= 30)
    found = first_harm_error(lines, rows, step_s)
    while (far := found > 1e-3).any() and step_s > 2e-7:
        step_s /= 10.0
        found[far] = first_harm_error(lines, rows[far], step_s)
    of = f"{worlds:,} worlds, {different} with other bits, {len(rows):,} by small steps of down to {step_s:g} s"
    return Figure(np.inf if different else float(found.max()), 1e-3, of)


# ---------------------------------------------------------------- worlds made backwards, impacts, motion between them


def inexactly(cases: list[Case]) -> Figure:
    """Return how many worlds differ from rational arithmetic in any bit, in one segment or in steps."""
    hits = sum(len(case.outcome.hits) for case in cases)
    wrong = sum(bool(at_once(case) or in_steps(case)) for case in cases)
    return Figure(wrong, 0, f"{len(cases)} worlds, {hits} impacts, at once and in steps of 1/8 s")


@cache
def impact_batches() -> list[tuple[Worlds, Worlds, Impacts]]:
    """Return touching lines of 2 to 50 vehicles before and after their impacts, with mass ratios up to a million."""
    batches = []
    for N in (2, 3, 5, 10, 50):
        for ratio in (1.0, 1e3, 1e6):
            before, command = touching_lines(21, 1_000_000 // N, N, heaviest_ratio=ratio)
            batches.append((before, *advance(before, command, 0.0)))
    return batches


def of_impacts(error: Callable[[Worlds, Worlds, Impacts], Floats], threshold: float) -> Figure:
    """Return the largest error at the impacts of these lines."""
    worst = max(float(np.max(error(*batch))) for batch in impact_batches())
    return Figure(worst, threshold, f"{sum(int(i.count.sum()) for *_, i in impact_batches()):,} impacts, N = 2 to 50")


def restitution() -> Figure:
    """Compare separation speeds with e times the closing speed."""
    worst, pairs = 0.0, 0
    for key in range(5):
        before, command = touching_lines(30 + key, 1_000_000, 2, heaviest_ratio=10.0**key)
        after, impacts = advance(before, command, 0.0)
        worst, pairs = max(worst, float(restitution_eps(before, after).max())), pairs + int(impacts.count.sum())
    return Figure(worst, RESTITUTION_EPS, f"{pairs:,} impacts of two vehicles")


def gaps() -> Figure:
    """Compare stored gaps with gaps computed from the speeds."""
    runs = [Watched(41 + N, 3_000 // N, N, drive=drive) for N in (2, 3, 5, 10) for drive in (False, True)]
    return Figure(max(run.worst for run in runs), GAP_M, f"{sum(run.checked for run in runs):,} steady steps")


@cache
def braking_runs() -> list[Watched]:
    """Return braking lines simulated in short steps."""
    return [Watched(51 + N, 3_000 // N, N, drive=False) for N in (2, 3, 5, 10)]


def of_braking(count: Callable[[Watched], int]) -> Figure:
    """Return how often ``count`` finds something in the braking lines."""
    seen = sum(int((state.speeds_mps < 0).sum()) for run in braking_runs() for state in run.states)
    of = f"{len(braking_runs()) * 300:,} steps of 3,000 vehicles, {seen:,} negative speeds seen"
    return Figure(sum(map(count, braking_runs())), 0, of)


def shares() -> Figure:
    """Check that harm shares of random harms and masses add up exactly."""
    draws, n = Draws(61), 2_000_000
    harm, mass = draws.uniform(0.0, 2_000.0, (n, 1)), 10.0 ** draws.uniform(-2.0, 4.0, (n, 2))
    both = split(harm, mass)
    rest = harm[:, 0] - both.max(axis=1)  # exact: the larger share is at least half
    return Figure(int(np.sum(rest != both.min(axis=1))), 0, f"{n:,} impacts")


def ledgers() -> Figure:
    """Compare first-impact and total harm of the ledger with the impacts of three segments, bit for bit."""
    wrong, impacts_seen = 0, 0
    for N in (2, 3, 6, 20):
        book, first, total, count = booked(62, 60_000 // N, N)
        same = (first == book.first_impact_harm) & (total == book.total_harm) & (count == book.count)
        wrong, impacts_seen = wrong + int((~same).any(axis=1).sum()), impacts_seen + int(count.sum())
    return Figure(wrong, 0, f"{impacts_seen:,} impacts")


# ---------------------------------------------------------------- contacts, and whole runs against exact arithmetic

CHUNK = 200_000


SEGMENTS = {2: 10_000_000, 3: 1_000_000, 5: 500_000}


@cache
def scans() -> list[Scan]:
    """Return the scans of all random segments."""
    found = []
    for N, n in SEGMENTS.items():
        rng = np.random.default_rng([71, N])
        found += [scan(random_segments(rng, CHUNK, N)) for _ in range(n // CHUNK)]
    return found


def of_scans(kind: str) -> Figure:
    """Compare contacts with the smallest value of each gap's closed form, and doubtful ones with exact arithmetic.

    Time and closing speed of the first contact are compared, or final gaps and speeds if there is no contact.
    """
    pairs, contacts, in_doubt = (sum(getattr(s, name) for s in scans()) for name in ("pairs", "contacts", "in_doubt"))
    of = f"{pairs:,} random segments of pairs, {contacts:,} with contact, {in_doubt:,} decided by exact arithmetic"
    return Figure(sum(getattr(s, kind).size for s in scans()), 0, of)


CASCADE = 100  # number of impacts of a world after which rounding may change their order
OTHER_CASCADES = 1e-3  # largest share of worlds in which rounding may do so


def run_difference(end: Worlds, found: Floats, k: int, line: Worlds, command: list[float]) -> float:
    """Return the largest difference of world k from the exact run.

    It is infinite if other impacts happen, and NaN if this is so only after ``CASCADE`` impacts.

    ``found`` [impacts, 3]: pair, time, closing speed.
    """
    exact = simulate(line_of(line, command, k), Fraction(HORIZON_S), bits=160)
    pairs, true_pairs = found[:, 0].tolist(), [hit.pair for hit in exact.hits]
    if pairs != true_pairs:
        return np.nan if pairs[:CASCADE] == true_pairs[:CASCADE] else np.inf
    ahead, true_ahead = ([], []) if exact.obstacle is None else ([end.obstacle_gap_m[k]], [exact.obstacle])
    mine = [*end.gaps_m[k], *end.speeds_mps[k], *ahead, *found[:, 1:].ravel()]
    truth = [*exact.gaps, *exact.speeds, *true_ahead, *(x for hit in exact.hits for x in (hit.time, hit.closing))]
    return max(abs(float(x) - float(y)) for x, y in zip(mine, truth, strict=True))


@cache
def differences(obstacle: bool) -> tuple[Floats, int, int]:
    """Return ``run_difference`` of every world, the number of impacts, and the number of impacts with the obstacle."""
    worst, impacts_seen, with_it = [], 0, 0
    for N, n in (
        {2: 1_500, 3: 1_000, 5: 300, 10: 40}.items()
        if obstacle
        else {2: 3_000, 3: 2_000, 5: 600, 10: 100, 50: 6}.items()
    ):
        batch = place_ahead(driving_lines(183, n, N), 184) if obstacle else driving_lines(81, n, N)
        end, impacts = advance(batch.worlds, batch.command, HORIZON_S, record=True)
        rows = impacts.rows
        columns = np.stack([rows.pair, rows.time_s, rows.closing_speed_mps], axis=1)
        for k in range(n):
            command = batch.command[k].tolist()
            worst.append(run_difference(end, columns[rows.world == k], k, batch.worlds, command))
        impacts_seen, with_it = impacts_seen + len(columns), with_it + int(impacts.obstacle_count.sum())
    return np.array(worst), impacts_seen, with_it


def of_runs(obstacle: bool) -> Figure:
    """Compare whole runs with exact runs: time and closing speed of every impact, final gaps and speeds."""
    found, impacts_seen, with_it = differences(obstacle)
    of = f"{np.isfinite(found).sum():,} worlds, {impacts_seen:,} impacts of pairs, {with_it:,} with an obstacle"
    return Figure(float(np.nanmax(found)), EXACT_RUN, of)


def law(key: int, counts: dict[int, int], obstacle: bool) -> Figure:
    """Compare speeds after simultaneous impacts of touching lines with the exact law.

    ``counts``: number of vehicles -> number of lines.
    """
    worst = 0.0
    for (N, n), ratio in product(counts.items(), (1.0, 1e3)):
        before, command = touching_lines(key, n, N, heaviest_ratio=ratio)
        before = replace(before, obstacle_gap_m=np.zeros(n)) if obstacle else before
        after, impacts = advance(before, command, 0.0)
        rounds = np.maximum(np.maximum(impacts.count.max(axis=1), impacts.obstacle_count), 1)
        worst = max(worst, *(law_error_eps(before, after, k, int(rounds[k])) for k in range(n)))
    return Figure(worst, CLUSTER_EPS, f"{2 * sum(counts.values()):,} clusters of 2 to 50 vehicles")


def resting() -> Figure:
    """Compare accelerations of touching lines at rest, moving, and at a speed limit with exact ones."""
    draws, found = Draws(83), []
    for N, speed, _ in product((2, 3, 5, 10, 25, 50), (0.0, 4.0, 8.0), range(150)):
        command, mass = draws.uniform(-16.0, 16.0, (N,)), draws.uniform(0.5, 8.0, (N,))
        expected = exact_accelerations(command.tolist(), mass.tolist(), speed)
        found.append(float(np.abs(accelerations(command, mass, speed) - expected).max()))
    return Figure(max(found), RESTING_MPS2, f"{len(found):,} lines of 2 to 50 vehicles")


# ---------------------------------------------------------------- an obstacle ahead of Vehicle 1


def cascades() -> Figure:
    """Return the share of worlds in which rounding changes the order of impacts after ``CASCADE`` impacts."""
    found, *_ = differences(obstacle=True)
    return Figure(float(np.isnan(found).mean()), OTHER_CASCADES, f"{found.size:,} worlds of 2 to 10 vehicles")


def out_of_reach() -> Figure:
    """Compare lines without an obstacle and with an obstacle that they never reach."""
    n, changed = 20_000, 0
    for N in (2, 3, 5):
        worlds, command = driving_lines(185, n, N)
        plain, harm = advance(worlds, command, until_s=HORIZON_S)
        far, same = advance(replace(worlds, obstacle_gap_m=np.full(n, 1e4)), command, until_s=HORIZON_S)
        changed += state_bytes(replace(far, obstacle_gap_m=plain.obstacle_gap_m), same) != state_bytes(plain, harm)
    return Figure(changed, 0, f"{3 * n:,} worlds of 2, 3 and 5 vehicles")


# ---------------------------------------------------------------- the end of every instant, of any masses

NEARLY_JOINED = {2: 200_000, 3: 300_000, 5: 200_000, 10: 200_000, 20: 80_000, 50: 20_000}  # by vehicles
THROWN = {2: 250_000, 3: 250_000, 5: 200_000, 10: 250_000, 20: 40_000, 50: 10_000}
INSTANT_CHUNK = 10_000


def unfinished(counts: dict[int, int], make: Callable[[int, int], Batch], until_s: float) -> int:
    """Return how many worlds cannot be advanced.

    ``counts``: number of vehicles -> number of worlds. ``make(vehicles, chunk)`` makes the worlds of a chunk.
    """
    failed = 0
    for N, n in counts.items():
        for chunk in range(n // INSTANT_CHUNK):
            worlds, command = make(N, chunk)
            try:
                advance(worlds, command, until_s=until_s)
            except PhysicsError as error:
                failed += len(error.worlds)
    return failed


def joined_clusters() -> Figure:
    """Check touching lines with equal speeds except for the last digits, half of them at an obstacle."""

    def make(N: int, chunk: int) -> Batch:
        worlds = nearly_joined(1_000 * N + chunk, INSTANT_CHUNK, N, obstacle=chunk % 2 == 1)
        return Batch(worlds, np.zeros((INSTANT_CHUNK, N)))

    failed = unfinished(NEARLY_JOINED, make, 0.0)
    return Figure(failed, 0, f"{sum(NEARLY_JOINED.values()):,} clusters of 2 to 50 vehicles")


def thrown() -> Figure:
    """Check that whole runs of 6 s of lines thrown at an obstacle can be advanced."""
    failed = unfinished(THROWN, lambda N, chunk: thrown_lines(100_000 + 1_000 * N + chunk, INSTANT_CHUNK, N), HORIZON_S)
    return Figure(failed, 0, f"{sum(THROWN.values()):,} worlds of 2 to 50 vehicles, masses 0.05 to 100 t")


# ---------------------------------------------------------------- what must not matter


@cache
def splits() -> list[Split]:
    """Return worlds whose segment was split into parts."""
    return [split_errors(N, 60_000 // N, cuts, 91) for N in (2, 3, 5, 10, 20) for cuts in (2, 7, 80)]


def splitting() -> Figure:
    """Return the largest relative error of gaps, speeds and harm of split segments, for worlds with up to 30 impacts.

    Errors are relative to at least 100 m, 30 m/s and 900 m2/s2.
    """
    worst = max(float(s.error[s.few].max()) for s in splits() if s.few.any())
    return Figure(worst, SPLIT, f"{sum(int(s.few.sum()) for s in splits()):,} worlds in 2, 7 and 80 parts")


def splitting_cascades() -> Figure:
    """Return the same error for worlds with more impacts, and the effect of the last digit of their gaps."""
    worst = max(float(s.error[~s.few].max()) for s in splits() if not s.few.all())
    digits = [last_digit_errors(N, 60_000 // N, 91) for N in (3, 5, 10, 20)]
    known = max(float(s.error[~s.few].max()) for s in digits)
    worlds = sum(int((~s.few).sum()) for s in splits())
    return Figure(
        worst, SPLIT_CASCADE, f"{worlds:,} worlds with more than 30 impacts; a last digit of their gaps: {known:.2g}"
    )


def origin() -> Figure:
    """Compare worlds with shifted times, bit for bit. Times are on a grid of 2^-20 s."""
    batch = driving_lines(92, 50_000, 4)
    v = batch.worlds.vehicles
    grid = replace(batch.worlds, vehicles=replace(v, latency_s=np.round(v.latency_s * 2**20) / 2**20))
    here, impacts = advance(grid, batch.command, until_s=6.0)
    changed = 0
    for shift in (-0.5, 64.0, 4096.0):
        vehicles = replace(grid.vehicles, latency_s=grid.vehicles.latency_s + shift)
        moved = replace(grid, vehicles=vehicles, time_s=grid.time_s + shift)
        there, same = advance(moved, batch.command, until_s=6.0 + shift)
        pairs = (
            (here.gaps_m, there.gaps_m),
            (here.speeds_mps, there.speeds_mps),
            (impacts.total_harm, same.total_harm),
        )
        changed += int(np.any([(a != b).any(axis=1) for a, b in pairs], axis=0).sum())
    return Figure(changed, 0, "50,000 worlds, three shifts (positions are not stored: space has no origin)")


def batches() -> Figure:
    """Compare worlds alone, in other orders, and in one or two threads, bit for bit."""
    n, changed = 20_000, 0
    batch = driving_lines(93, n, 3)
    whole = state_bytes(*once(batch))

    def together(parts: list[tuple[Worlds, Impacts]]) -> tuple[bytes, ...]:
        harm = [np.concatenate([getattr(i, f) for _, i in parts]) for f in HARMS]
        return state_bytes(Worlds.concatenate([world for world, _ in parts]), Impacts(*harm))

    def chunk(rows: np.ndarray) -> tuple[Worlds, Impacts]:
        return once(Batch(batch.worlds.take(rows), batch.command[rows]))

    changed += together([chunk(np.array([k])) for k in range(n)]) != whole
    changed += state_bytes(*advance(batch.worlds, batch.command, until_s=HORIZON_S, threads=2)) != whole
    with ThreadPoolExecutor(2) as pool:
        changed += together(list(pool.map(chunk, np.array_split(np.arange(n), 64)))) != whole
    for seed in range(10):
        order = np.random.default_rng(seed).permutation(n)
        world, impacts = chunk(order)
        back = np.argsort(order)
        harm = [getattr(impacts, f)[back] for f in HARMS]
        changed += state_bytes(world.take(back), Impacts(*harm)) != whole
    return Figure(changed, 0, f"{n:,} worlds alone, on 2 threads (threads=2, and 64 parts by hand), in 10 orders")


def golden() -> Figure:
    """Compare with ``tests/golden/physics_worlds.json``."""
    found = figures()
    return Figure(
        int(found != json.loads(GOLDEN.read_text("utf-8"))["all"]), 0, f"sha256 {str(found['sha256'])[:16]}..."
    )


def bounces() -> Figure:
    """Compare series of bounces with the geometric sum of their flight times, for e from 0.05 to 0.99."""
    worst = 0.0
    for e in np.linspace(0.05, 0.99, 95):
        wall = replace(touching_lines(0, 1, 2).worlds, speeds_mps=np.array([[0.0, 8.0]]))
        vehicles = replace(wall.vehicles, mass_t=np.array([[2.0**50, 1.0]]), restitution=np.array([e]))
        _, impacts = advance(replace(wall, vehicles=vehicles), [-8.0, 4.0], 2_000.0, record=True)
        closing = [8.0]
        while closing[-1] >= 0.05:
            closing.append(closing[-1] * e)
        flights = sum(2.0 * w / 4.0 for w in closing[1:])
        if impacts.count[0, 0] != len(closing):
            return Figure(np.nan, 0, f"e = {e}: {impacts.count[0, 0]} impacts instead of {len(closing)}")
        worst = max(worst, abs(float(impacts.rows.time_s[-1]) / flights - 1.0))
    return Figure(worst, BOUNCE_SERIES_EPS * EPS, "95 series of up to 506 impacts")


# ---------------------------------------------------------------- the gates

GATES: dict[str, Callable[[], Figure]] = {
    "manufactured worlds, not bit for bit": lambda: inexactly(
        stored() + manufactured(9, 2, 1_500) + manufactured(9, 3, 400) + manufactured(9, 4, 100)
    ),
    "resting contact worlds, not bit for bit": lambda: inexactly(
        [case for N in (2, 3, 4, 5) for case in pressed(11, N, 1_000)]
    ),
    "momentum at impacts [eps of sum m |v|, per round]": lambda: of_impacts(
        lambda b, a, i: momentum_eps(b, a) / rounds(i), MOMENTUM_EPS
    ),
    "energy rise at impacts [eps of the energy, per round]": lambda: of_impacts(
        lambda b, a, i: energy_rise_eps(b, a) / rounds(i), ENERGY_EPS
    ),
    "restitution of pairs [eps of the larger speed]": restitution,
    "gap against its closed form, and below 0 [m]": gaps,
    "speeds below 0 that no bounce-back explains": lambda: of_braking(Watched.unexplained_negative_speeds),
    "steps in which energy rose although no vehicle drives": lambda: of_braking(Watched.energy_rises),
    "harm shares that do not add up to the last bit": shares,
    "worlds whose ledger is not the sum of its rows": ledgers,
    "contacts missed": lambda: of_scans("missed"),
    "contacts invented": lambda: of_scans("phantom"),
    "contacts or gaps misplaced": lambda: of_scans("wrong"),
    "difference from exact runs [m, m/s, s]": lambda: of_runs(obstacle=False),
    "runs with other impacts than exact ones": lambda: Figure(
        int((~np.isfinite(differences(obstacle=False)[0])).sum()), 0, "the same worlds"
    ),
    "cluster law [eps of the largest speed, per round]": lambda: law(
        82, {2: 3_000, 3: 3_000, 5: 1_500, 10: 400, 20: 150, 50: 30}, obstacle=False
    ),
    "resting contact against exact force ranges [m/s2]": resting,
    "obstacle: cluster law [eps of the largest speed, per round]": lambda: law(
        182, {2: 1_500, 3: 1_500, 5: 800, 10: 200, 20: 80, 50: 15}, obstacle=True
    ),
    "obstacle: difference from exact runs [m, m/s, s]": lambda: of_runs(obstacle=True),
    "obstacle: worlds that differ after 100 impacts [share]": cascades,
    "obstacle out of reach: worlds with other bits": out_of_reach,
    "instants that do not end: clusters a few ulps apart": joined_clusters,
    "instants that do not end: lines thrown against an obstacle": thrown,
    "a segment that is split, few impacts [relative]": splitting,
    "a segment that is split, cascades [relative]": splitting_cascades,
    "a segment that is split, worlds with other impacts": lambda: Figure(
        sum(int(s.other.sum()) for s in splits()), 0, "the same worlds"
    ),
    "worlds changed by the origin of time": origin,
    "batches whose bits depend on their make-up": batches,
    "golden hash of 10,000 worlds, different": golden,
    "bounces: total time of a series [relative]": bounces,
}
