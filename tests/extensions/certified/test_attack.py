"""Attacks on the robust shield: true worlds are corners of the intervals, 54 times ``--size`` by way and count."""

from itertools import product

import numpy as np
import pytest

from tests.extensions.certified.attack import UNCERTAINTIES, robust
from tests.shields.attack import WAYS

AT_ONCE = 500  # worlds attacked together


@pytest.mark.nightly
@pytest.mark.parametrize("intervals", UNCERTAINTIES)
def test_true_corners__do_at_most_the_bound(intervals: str, size: int) -> None:
    firsts = range(0, 54 * size, AT_ONCE)
    found = [
        robust(intervals, count, way, min(AT_ONCE, 54 * size - first), 1 + 1000 * k + first)
        for k, (count, way) in enumerate(product(("first", "total"), WAYS))
        for first in firsts
    ]
    above, rises, decisions, replaced = (
        sum(int(np.sum(getattr(each, key))) for each in found) for key in ("above", "rises", "decisions", "replaced")
    )
    print(f"{sum(len(each.harm) for each in found):,} worlds, {decisions:,} decisions, {replaced:,} replaced")
    assert above == rises == 0 and replaced > 0 and all(each.trusted.all() for each in found)
