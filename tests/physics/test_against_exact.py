"""Whole runs against the exact simulator, contact times to 160 binary digits."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from ethbrake_marl.physics import advance
from tests.physics.exact_simulator import line_of, simulate
from tests.physics.random_worlds import driving_lines

HORIZON_S = 6.0
CLOSE = 1e-9


@pytest.mark.parametrize(("N", "n"), [(2, 60), (3, 50), (5, 20), (10, 6), (25, 1)])
@pytest.mark.parametrize("drive", [True, False])
def test_advance__agrees_with_exact_arithmetic_event_by_event(N, n, drive):
    worlds, command = driving_lines(51 + drive, n, N, drive=drive)
    end, impacts = advance(worlds, command, HORIZON_S, record=True)
    rows, hits = impacts.rows, 0
    for k in range(n):
        exact = simulate(line_of(worlds, command[k].tolist(), k), Fraction(HORIZON_S), bits=160)
        mine = rows.world == k
        columns = (rows.time_s, rows.closing_speed_mps, rows.front_speed_change_mps, rows.rear_speed_change_mps)
        found = np.stack([c[mine] for c in columns], axis=1)
        truth = np.array([[float(x) for x in (h.time, h.closing, *h[4:])] for h in exact.hits]).reshape(-1, 4)
        assert list(zip(rows.pair[mine], rows.first[mine], strict=True)) == [(h.pair, h.first) for h in exact.hits]
        np.testing.assert_allclose(found, truth, rtol=0, atol=CLOSE)
        np.testing.assert_allclose(end.gaps_m[k], [float(g) for g in exact.gaps], rtol=0, atol=CLOSE)
        np.testing.assert_allclose(end.speeds_mps[k], [float(v) for v in exact.speeds], rtol=0, atol=CLOSE)
        hits += len(exact.hits)
    assert hits > n / 2
