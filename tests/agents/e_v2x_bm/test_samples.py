"""Samples of one world's harm: what is expected between them, their minima, and the choice among them."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.e_v2x_bm import (
    MINIMA,
    Samples,
    bound_cells,
    choose,
    find_minima,
    find_smallest,
    merge,
    put_in_order,
)


def samples(at, harm, other=None) -> Samples:
    found = Samples(*(np.array(column, dtype=float) for column in (at, harm, harm if other is None else other, at)))
    put_in_order(found, len(found.at))
    return found


def bounds(at, harm) -> list[float]:
    found = np.empty(len(at) - 1)
    bound_cells(samples(at, harm), len(at), found)
    return found.tolist()


def minima(found: Samples) -> tuple[list[int], list[bool]]:
    """Places of the lowest minima, and which of them are minima at all."""
    depth, places = np.empty(len(found.at)), np.empty(MINIMA, np.int64)
    find_minima(found, len(found.at), depth, places)
    return places.tolist(), np.isfinite(depth[places]).tolist()


@pytest.mark.parametrize(
    ("harm", "other", "expected"),
    [
        ([3, 1, 2, 2, 4], [0, 9, 0, 0, 0], 1.0),  # the harm decides
        ([3, 1, 1, 2, 4], [0, 9, 8, 0, 0], 2.0),  # a tie: the other count decides
        ([3, 0, 0, 0, 4], [0, 0, 0, 0, 0], 2.0),  # still a tie: the middle one
        ([0, 0, 3, 0, 0], [1, 1, 1, 1, 1], 1.0),  # of an even number the lower one
    ],
)
def test_choose__order_of_preference(harm, other, expected):
    found = samples([0, 1, 2, 3, 4], harm, other)
    assert choose(found, 5, np.empty(5)) == expected
    back = Samples(*(column[::-1].copy() for column in found))
    assert choose(back, 5, np.empty(5)) == expected


def test_find_minima__in_order_of_depth_whatever_the_order_of_samples():
    places, are = minima(samples([4, 0, 1, 3, 2, 5], [1, 5, 2, 6, 3, 7]))  # sorted: 5 2 3 6 1 7
    assert places[:2] == [4, 1]
    assert are == [True, True, False, False, False, False]  # no third minimum: nothing to narrow
    assert places[2:] == [0, 2, 3, 5]


def test_find_minima__keeps_the_six_lowest():
    depths = [7, 3, 6, 1, 5, 2, 4]
    zigzag = [value for depth in depths for value in (9, depth)] + [9]
    places, are = minima(samples(range(len(zigzag)), zigzag))
    assert [zigzag[place] for place in places] == [1, 2, 3, 4, 5, 6] and all(are)


def test_bound_cells__let_a_falling_side_run_on():
    # Middle cell: falling by 2 on its left, rising by 3 on its right, each up to twice as fast inside: 3 - 4, 1 - 6.
    assert bounds(np.arange(4.0), [5.0, 3.0, 1.0, 4.0]) == [3.0, -5.0, -3.0]
    # With uneven samples the slope counts: falling by 2 over 1, then a cell twice as wide: 3 - 2 * 2 * 2.
    assert bounds([0.0, 1.0, 3.0], [5.0, 3.0, 4.0])[1] == -5.0


def test_find_smallest__is_a_stable_sort():
    rng = np.random.default_rng(4)
    for n in (6, 7, 40):
        values = rng.choice([1.0, 2.0, 3.0, np.inf], n)
        places = np.empty(6, np.int64)
        find_smallest(values, n, places)
        assert places.tolist() == np.argsort(values, kind="stable")[:6].tolist()


def test_merge__keeps_the_order():
    one, other = samples([0, 2, 2, 5], [1, 2, 3, 4]), samples([1, 2, 6], [5, 6, 7])
    into = samples(np.zeros(7), np.zeros(7))
    merge(one, 4, other, 3, into)
    assert into.at.tolist() == [0, 1, 2, 2, 2, 5, 6]
    assert into.harm.tolist() == [1, 5, 2, 3, 6, 4, 7]
