"""No contact is missed and none is invented, grazing ones included."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.physics.kernel import contact
from tests.physics.exact_simulator import square_root
from tests.physics.segments import Scan, Segments, meetings, random_segments, scan
from tests.reference.tolerances import BORDERLINE_SHARE, CONTACT_TIME_EPS, EPS

TOUCH_MPS = 1e-5


def clean(found: Scan) -> None:
    """Nothing missed, invented or misplaced; and the scan said something."""
    assert (found.missed.tolist(), found.phantom.tolist(), found.wrong.tolist()) == ([], [], [])
    assert found.contacts > 0.1 * found.pairs / 4 and found.in_doubt > 0
    assert found.borderline <= BORDERLINE_SHARE * found.pairs


@pytest.mark.parametrize(("N", "n"), [(2, 60_000), (3, 10_000), (5, 5_000)])
def test_contacts__none_missed_and_none_invented(N, n):
    clean(scan(random_segments(np.random.default_rng([5, N]), n, N)))


def test_scan__finds_what_is_planted():
    # the comparison itself: with other gaps than the kernel's, contacts are missed and invented
    segments = random_segments(np.random.default_rng(6), 3_000, 2)
    meeting = meetings(segments)
    moved = make_worlds(
        segments.worlds.gaps_m + 0.5, segments.worlds.speeds_mps, braking_capacity_mps2=9, driving_capacity_mps2=9,
        latency_s=segments.worlds.vehicles.latency_s, mass_t=1.0, restitution=0.0, speed_limit_mps=60.0,
    )  # fmt: skip
    shifted = meetings(Segments(moved, segments.command, segments.duration))
    assert np.isfinite(meeting.time).sum() > np.isfinite(shifted.time).sum() + 100
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.physics.segments.meetings", lambda _: shifted)
        assert scan(segments).phantom.size > 100
        patch.setattr("tests.physics.segments.meetings", lambda _: meeting)
        assert scan(Segments(moved, segments.command, segments.duration)).missed.size > 100


def graze(excess_m: float, w: float = 4.0, b: float = -2.0) -> int:
    """Impacts of a pair whose smallest gap would be ``-excess_m``."""
    worlds = make_worlds(
        [w * w / (2.0 * -b) - excess_m], [10.0, 10.0 + w], braking_capacity_mps2=9, driving_capacity_mps2=9,
        latency_s=0, mass_t=1, restitution=0.0,
    )  # fmt: skip
    return int(advance(worlds, [0.0, b], 3.0)[1].count[0, 0])


@pytest.mark.parametrize("excess", [1e-9, 1e-7, 1e-4, 0.1])
def test_graze__counts_from_the_touch_speed_on(excess):
    # D = 2 |b| excess = 4 excess; an impact when it exceeds (1e-5 m/s)^2
    assert graze(excess) == 1
    assert graze(-excess) == 0
    assert graze(0.0) == 0


def test_graze__below_the_touch_speed_is_no_impact():
    assert graze(0.9 * TOUCH_MPS**2 / 4.0) == 0
    assert graze(1.1 * TOUCH_MPS**2 / 4.0) == 1


def test_contact_time__is_right_to_the_last_digits_where_the_textbook_root_is_not():
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
