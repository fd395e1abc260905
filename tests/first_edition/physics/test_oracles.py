"""The exact advance against other programs: rational arithmetic, and closed forms."""

from collections import Counter
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from math import ceil

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.motion import contact
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from tests.first_edition.physics.manufacture import Case, floats, manufactured, pressed, stored, worlds_of
from tests.first_edition.physics.random_worlds import (
    HORIZON_S,
    driving_lines,
    line,
    line_of,
    place_ahead,
    touching_lines,
)
from tests.first_edition.physics.segments import meetings, random_segments, scan
from tests.reference.exact_simulator import Hit, Line, regression, simulate, square_root
from tests.reference.tolerances import CLUSTER_EPS, CONTACT_TIME_EPS, EPS

# ---------------------------------------------------------------- rational arithmetic, contact times to 160 bits

CLOSE = 1e-9


@pytest.mark.parametrize(("N", "n"), [(2, 30), (3, 25), (5, 10), (10, 3)])
@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("drive", [True, False])
def test_advance__agrees_with_exact_arithmetic_event_by_event(N: int, n: int, obstacle: bool, drive: bool) -> None:
    batch = driving_lines(51 + drive, n, N, drive=drive)
    worlds, command = place_ahead(batch, 152) if obstacle else batch
    end, impacts = advance(worlds, command, HORIZON_S, record=True)
    rows, hits = impacts.rows, []
    for k in range(n):
        exact = simulate(line_of(worlds, command[k].tolist(), k), Fraction(HORIZON_S), bits=160)
        mine = rows.world == k
        columns = (rows.time_s, rows.closing_speed_mps, rows.front_speed_change_mps, rows.rear_speed_change_mps)
        found = np.stack([c[mine] for c in columns], axis=1)
        truth = np.array([[float(x) for x in (h.time, h.closing, *h[4:])] for h in exact.hits]).reshape(-1, 4)
        assert list(zip(rows.pair[mine], rows.first[mine], strict=True)) == [(h.pair, h.first) for h in exact.hits]
        np.testing.assert_allclose(found, truth, rtol=0, atol=CLOSE)
        ends = [*end.gaps_m[k], *end.speeds_mps[k], *(end.obstacle_gap_m[[k]] if obstacle else ())]
        exact_ends = [*exact.gaps, *exact.speeds, *([exact.obstacle] if obstacle else ())]
        np.testing.assert_allclose(ends, [float(x) for x in exact_ends], rtol=0, atol=CLOSE)
        hits += exact.hits
    assert len(hits) > n / 2 and (not obstacle or sum(hit.pair < 0 for hit in hits) > n / 4)


# ---------------------------------------------------------------- worlds made backwards: every bit

STEP = Fraction(1, 8)


@pytest.fixture(scope="module")
def cases() -> tuple[list[Case], list[Case]]:
    """Those of the golden file, and fresh ones that touch at the start."""
    return stored(), [case for N in (2, 3, 4, 5) for case in pressed(7, N, 40)]


def differs(case: Case, ends: list[Fraction]) -> str:
    """What is not exactly as in rational arithmetic, advanced to one end after the other; empty if nothing is."""
    world, impacts, exact = worlds_of([case.line]), [], case.outcome
    for end in ends:
        world, found = advance(world, floats(case.line.command), until_s=float(end), record=True)
        rows = found.rows
        columns = (rows.time_s, rows.pair, rows.closing_speed_mps, rows.first)
        impacts += zip(*columns, rows.front_speed_change_mps, rows.rear_speed_change_mps, strict=True)
    mine = impacts, world.gaps_m[0].tolist(), world.speeds_mps[0].tolist()
    truth = exact.hits, floats(exact.gaps), floats(exact.speeds)
    return "" if mine == truth else f"{case.line}: {mine}, exactly {truth}"


def at_once(case: Case) -> str:
    return differs(case, [case.until])


def in_steps(case: Case) -> str:
    return differs(case, [*(STEP * k for k in range(1, ceil(case.until / STEP))), case.until])


def test_manufactured__hundreds_of_worlds_with_every_kind_of_event(cases) -> None:
    sizes, case = Counter(len(case.line.speeds) for case in cases[0]), cases[0][-1]
    assert sizes.total() >= 500 and set(sizes) == {2, 3, 4, 5}
    kinds = sum((case.outcome.kinds for case in (*cases[0], *cases[1])), Counter())
    assert len(kinds) == 9 and min(kinds.values()) >= 20, kinds
    assert line_of(worlds_of([case.line]), floats(case.line.command), 0) == case.line


def test_manufactured_and_pressed__the_kernel_finds_every_bit(cases) -> None:
    made = [*cases[0], *manufactured(2, 2, 40), *manufactured(2, 3, 5)]
    assert [wrong for case in (*made, *cases[1]) if (wrong := at_once(case))] == []
    assert [wrong for case in (*made[::3], *cases[1]) if (wrong := in_steps(case))] == []


# ---------------------------------------------------------------- many touching vehicles: the min-max formula


def law_error_eps(before: Worlds, after: Worlds, k: int, rounds: int) -> float:
    """Largest difference of world k's speeds from the exact law, in eps of its largest speed and per round."""
    exact = simulate(line_of(before, [0.0] * before.N, k), Fraction(0))
    scale = max(np.abs(before.speeds_mps[k]).max(), np.abs(after.speeds_mps[k]).max())
    off = [abs(Fraction(float(v)) - u) for v, u in zip(after.speeds_mps[k], exact.speeds, strict=True)]
    return float(max(off)) / scale / EPS / rounds


@pytest.mark.parametrize(("N", "n"), [(2, 150), (3, 150), (4, 100), (8, 40), (20, 10), (50, 4)])
@pytest.mark.parametrize(("ratio", "obstacle"), [(1.0, False), (1e3, False), (1.0, True)])
def test_cluster__of_any_size_follows_the_exact_law(N: int, n: int, ratio: float, obstacle: bool) -> None:
    before, command = touching_lines(71, n, N, heaviest_ratio=ratio)
    if obstacle:
        before = replace(before, obstacle_gap_m=np.zeros(n))
    after, impacts = advance(before, command, 0.0)
    rounds = np.maximum(np.maximum(impacts.count.max(axis=1), impacts.obstacle_count), 1)
    assert max(law_error_eps(before, after, k, int(rounds[k])) for k in range(n)) <= CLUSTER_EPS
    assert (impacts.count > 0).sum(axis=1).max() >= min(N - 1, 3)
    assert not obstacle or (after.speeds_mps[:, 0] <= 0.0).all()


def test_cluster__impacts_are_those_of_the_exact_rounds() -> None:
    before, command = touching_lines(72, 150, 6)
    rows = advance(before, command, 0.0, record=True)[1].rows
    for k in range(150):
        exact = [hit for hit in simulate(line_of(before, [0.0] * 6, k), Fraction(0)).hits if hit.closing > 1e-4]
        mine = (rows.world == k) & (rows.closing_speed_mps > 1e-4)
        found = np.stack([rows.closing_speed_mps, rows.front_speed_change_mps, rows.rear_speed_change_mps])[:, mine]
        assert rows.pair[mine].tolist() == [hit.pair for hit in exact]
        truth = np.array([[float(x) for x in (hit.closing, *hit[4:])] for hit in exact]).reshape(-1, 3)
        np.testing.assert_allclose(found.T, truth, rtol=0, atol=1e-12)


def accelerations(command: list[float], mass: list[float], speed: float) -> Floats:
    """Accelerations of touching vehicles at one speed, from their speeds after 1/64 s."""
    n = len(command)
    worlds = line(np.zeros(n - 1), np.full(n, speed), mass_t=mass, speed_limit_mps=8.0)
    after, impacts = advance(worlds, command, 1.0 / 64.0)
    assert impacts.count.sum() == 0
    return (after.speeds_mps[0] - speed) * 64.0


def exact_accelerations(command: list[float], mass: list[float], speed: float) -> Floats:
    """The same from ranges of force, by the min-max formula."""
    low = [Fraction(0) if u > 0 and speed == 8.0 else Fraction(u) for u in command]
    high = [-Fraction(u) if u < 0 and speed == 0.0 else Fraction(u) for u in command]
    return np.array([float(a) for a in regression(tuple(map(Fraction, mass)), low, high)])


MEMBERS = st.tuples(st.floats(-16.0, 16.0, width=16).map(lambda u: round(u, 3)), st.floats(0.25, 64.0, width=16))


@settings(max_examples=100)
@given(st.lists(MEMBERS, min_size=2, max_size=8) | st.lists(MEMBERS, min_size=10, max_size=50))
@pytest.mark.parametrize("speed", [0.0, 4.0, 8.0])
def test_resting__accelerations_are_the_generalised_regression_of_force_ranges(speed: float, members) -> None:
    command, mass = (list(column) for column in zip(*members, strict=True))
    found = accelerations(command, mass, speed)
    np.testing.assert_allclose(found, exact_accelerations(command, mass, speed), rtol=0, atol=1e-9)
    assert np.all(np.diff(found) <= 1e-9)  # nobody presses into the one before


@settings(max_examples=40)
@given(st.lists(st.tuples(st.fractions(0, 30), st.fractions(1, 8)), min_size=1, max_size=7))
def test_oracle__the_min_max_formula_is_the_best_decreasing_fit(vehicles) -> None:
    v, mass = zip(*vehicles, strict=True)
    fit = regression(mass, v, v)
    assert all(a >= b for a, b in pairwise(fit))
    assert sum(m * (a - b) for m, a, b in zip(mass, fit, v, strict=True)) == 0
    blocks = [[k for k in range(len(fit)) if fit[k] == value] for value in dict.fromkeys(fit)]
    for block in blocks:  # each block is the mean of its members, and none of its heads pulls ahead of its tail
        for cut in range(1, len(block)):
            parts = block[:cut], block[cut:]
            head, tail = (sum(mass[k] * v[k] for k in part) / sum(mass[k] for k in part) for part in parts)
            assert head <= tail


# ---------------------------------------------------------------- closed forms: no contact is missed, none is invented


@pytest.mark.parametrize(("N", "n"), [(2, 60_000), (3, 10_000), (5, 5_000)])
def test_contacts__none_missed_and_none_invented(N: int, n: int) -> None:
    found = scan(random_segments(np.random.default_rng([5, N]), n, N))
    assert (found.missed.tolist(), found.phantom.tolist(), found.wrong.tolist()) == ([], [], [])
    assert found.contacts > 0.1 * found.pairs / 4 and found.in_doubt > 0


def test_scan__finds_what_is_planted(monkeypatch: pytest.MonkeyPatch) -> None:
    # the comparison itself: with other gaps than the kernel's, contacts are missed and invented
    segments = random_segments(np.random.default_rng(6), 3_000, 2)
    moved = replace(segments, worlds=replace(segments.worlds, gaps_m=segments.worlds.gaps_m + 0.5))
    near, far = meetings(segments), meetings(moved)
    monkeypatch.setattr("tests.first_edition.physics.segments.meetings", lambda _: far)
    assert scan(segments).phantom.size > 100
    monkeypatch.setattr("tests.first_edition.physics.segments.meetings", lambda _: near)
    assert scan(moved).missed.size > 100


@pytest.mark.parametrize(
    ("excess", "count"),
    [(-0.1, 0), (-1e-9, 0), (0.0, 0), (0.9e-10 / 4.0, 0), (1.1e-10 / 4.0, 1), (1e-9, 1), (1e-4, 1), (0.1, 1)],
)
def test_graze__counts_from_the_touch_speed_on(excess: float, count: int) -> None:
    # the smallest gap would be -excess: D = 2 |b| excess = 4 excess; an impact when it exceeds (1e-5 m/s)^2
    assert advance(line([4.0 - excess], [10.0, 14.0]), [0.0, -2.0], 3.0)[1].count.tolist() == [[count]]


def test_contact_time__is_right_to_the_last_digits_where_the_textbook_root_is_not() -> None:
    rng = np.random.default_rng(7)
    for _ in range(3_000):
        w, b = float(rng.uniform(-20.0, 20.0)), float(rng.uniform(-16.0, 16.0))
        g = float(10.0 ** rng.uniform(-12.0, 1.0))
        square = Fraction(w) ** 2 + 2 * Fraction(b) * Fraction(g)
        time, speed = contact(g, w, b)
        if square < 0 or (w <= 0.0 and b <= 0.0):
            assert (time, speed) == (np.inf, 0.0)
            continue
        condition = 1 + (w * w + 2.0 * abs(b) * g) / max(float(square), 1e-300)
        root, _ = square_root(square, 120)
        exact = 2 * Fraction(g) / (Fraction(w) + root) if w > 0 else (root - Fraction(w)) / Fraction(b)
        assert abs(Fraction(time) / exact - 1) <= CONTACT_TIME_EPS * EPS * condition
        assert abs(Fraction(speed) / root - 1) <= CONTACT_TIME_EPS * EPS * condition


def test_exact_simulator__by_hand() -> None:
    # 10 m at 10 m/s: meets after 1 s; masses 2 and 3, e = 1/2: +9 and -6; one more second opens 5 m
    f = Fraction
    told = Line((f(10),), (f(0), f(10)), (f(0),) * 2, (f(0),) * 2, (f(2), f(3)), (f(99),) * 2, f(1, 2))
    outcome = simulate(told, f(2))
    assert outcome.hits == [Hit(f(1), 0, f(10), True, f(9), f(-6))]
    assert outcome.gaps == (5,)
    assert outcome.speeds == (9, 4)
    assert np.isclose(float(simulate(told, f(2), bits=80).speeds[0]), 9.0)
