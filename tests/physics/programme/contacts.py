"""Gates on contacts: none missed, none invented; and whole runs against exact arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from ethbrake_marl.physics import advance
from tests.physics.exact_simulator import line_of, simulate
from tests.physics.programme.gates import Figure, gate
from tests.physics.random_worlds import Draws, driving_lines, rounds, touching_lines
from tests.physics.segments import Scan, random_segments, scan
from tests.physics.test_oracles import accelerations, exact_accelerations, law_error_eps
from tests.reference.tolerances import BORDERLINE_SHARE, CLUSTER_EPS, EXACT_RUN, RESTING_MPS2

CHUNK = 200_000

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
    return Figure(sum(s.borderline for s in scans()) / pairs, BORDERLINE_SHARE, "the same segments")


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
    return Figure(worst, EXACT_RUN, f"{total:,} worlds of 2 to 50 vehicles, {impacts_seen:,} impacts")


@gate("runs with other impacts than exact ones")
def exact_counts() -> Figure:
    """The order and the number of impacts of every pair."""
    _, other, _, _ = differences()
    return Figure(other, 0, "the same worlds")


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
    return Figure(worst, RESTING_MPS2, f"{lines:,} lines of 2 to 50 vehicles")
