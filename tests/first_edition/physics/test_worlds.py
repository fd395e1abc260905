"""Building, selecting, joining and packing worlds: nothing is lost, nothing is shared."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.state import Worlds, make_worlds
from tests.first_edition.physics.random_worlds import line


def columns(worlds: Worlds) -> dict[str, np.ndarray]:
    """Every array of the worlds and of their vehicles by name."""
    state = {f.name: getattr(worlds, f.name) for f in fields(worlds)[1:]}
    return {**state, **{f.name: getattr(worlds.vehicles, f.name) for f in fields(worlds.vehicles)}}


def assert_same(one: Worlds, expected: dict[str, np.ndarray]) -> None:
    for name, column in columns(one).items():
        np.testing.assert_array_equal(column, expected[name], err_msg=name, strict=True)


def numbered(n: int, first: int = 0, N: int = 3, *, told: bool = True) -> Worlds:
    """``n`` worlds whose every number tells which world it belongs to; ``told``: with news of their own."""
    number = np.arange(first, first + n, dtype=np.float64)
    wide, vehicle = number[:, None], np.arange(1.0, N + 1.0)
    worlds = line(
        wide + 0.25 * vehicle[1:], wide + vehicle, braking_capacity_mps2=wide + 3.0 + vehicle,
        driving_capacity_mps2=wide + 6.0 + vehicle, latency_s=wide + 0.125 * vehicle, mass_t=wide + 1.5 * vehicle,
        speed_limit_mps=wide + 99.0 + vehicle, restitution=number / 1000.0,
    )  # fmt: skip
    news = (wide + np.arange(float(N * N))).reshape(n, N, N)
    own = wide + 0.0625 * np.arange(float(N))
    if told:
        worlds = replace(worlds, vehicles=replace(worlds.vehicles, own_latency_s=own, known_from_s=news))
    return replace(
        worlds,
        time_s=number + 0.75,
        pair_hit=(number[:, None] + np.arange(N - 1)) % 2 == 0,
        command_mps2=wide - vehicle,
        obstacle_gap_m=number + 40.0,
        obstacle_hit=number % 2 == 1,
    )


@pytest.mark.parametrize(
    ("gaps", "speeds"),
    [
        ([[1.0, 2.0], [3.0, 4.0]], [10.0, 11.0, 12.0]),
        ([1.0, 2.0], np.full((3, 3), 9.0)),
        ([0.0, 0.0], [0.0, 64.0, 0.0]),
    ],
)
def test_make_worlds__one_set_of_gaps_or_of_speeds_is_that_of_all_worlds(gaps: Any, speeds: Any) -> None:
    # and the ends of every range are within it
    worlds = line(gaps, speeds, driving_capacity_mps2=0.0, latency_s=0.0, restitution=1.0, obstacle_gap_m=0.0)
    expected = [np.broadcast_to(given, (worlds.n, len(np.atleast_2d(given)[0]))).tolist() for given in (gaps, speeds)]
    assert [worlds.gaps_m.tolist(), worlds.speeds_mps.tolist()] == expected


@pytest.mark.parametrize("rows", [[2, 0], np.array([False, True, True, False])])
def test_take__selects_every_column_and_copies(rows: Any) -> None:
    worlds = numbered(4)
    some = worlds.take(rows)
    assert_same(some, {name: column[np.asarray(rows)] for name, column in columns(worlds).items()})
    for name, column in columns(some).items():
        assert not np.shares_memory(column, columns(worlds)[name]) and column.flags.c_contiguous, name


def test_concatenate__is_the_inverse_of_take() -> None:
    worlds = numbered(5)
    assert_same(Worlds.concatenate([worlds.take([0, 1]), worlds.take([2]), worlds.take([3, 4])]), columns(worlds))


def test_assign__replaces_rows_and_leaves_the_given_worlds_alone() -> None:
    worlds, fresh = numbered(4), numbered(2, first=50)
    expected = {name: column.copy() for name, column in columns(worlds).items()}
    for name, column in columns(fresh).items():
        expected[name][[3, 1]] = column
    assert_same(worlds.assign(np.array([3, 1]), fresh), expected)
    assert_same(worlds, columns(numbered(4)))


# ---------------------------------------------------------------- rows


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize(("n", "N"), [(1, 2), (1, 3), (40, 3), (7, 6)])
def test_packed__gives_back_every_bit_in_its_own_memory_widened_or_not(n: int, N: int, told: bool) -> None:
    given = numbered(n, N=N, told=told)
    for worlds in (given, replace(given, obstacle_gap_m=np.full(n, np.inf), obstacle_hit=np.zeros(n, bool))):
        rows = Packed.of(worlds)
        assert (rows.has_news, rows.has_obstacle) == (told, worlds is given)
        back, wide = rows.worlds(), rows.widened(obstacle=True, news=True).worlds()
        rows.state[:], rows.params[:] = -1.0, -1.0
        assert_same(back, columns(worlds))
        assert_same(wide, columns(worlds))


def test_make_worlds__starts_at_the_alert_with_nothing_hit_and_nothing_commanded() -> None:
    given = {"braking_capacity_mps2": 1, "driving_capacity_mps2": 0, "latency_s": 0, "mass_t": 1, "restitution": 1}
    worlds = make_worlds([5.0, 6.0], [9.0, 9.0, 9.0], **given)
    assert worlds.n == 1
    assert worlds.N == 3
    assert worlds.time_s.tolist() == [0.0]
    assert worlds.pair_hit.tolist() == [[False, False]]
    assert worlds.pair_hit.dtype == np.bool_
    assert worlds.command_mps2.tolist() == [[0.0, 0.0, 0.0]]
    assert worlds.obstacle_gap_m.tolist() == [np.inf]
    assert worlds.vehicles.speed_limit_mps.tolist() == [[40.0, 40.0, 40.0]]


def test_with_obstacle__writes_it_out_in_front() -> None:
    worlds = replace(line([5.0], [10.0, 9.0], obstacle_gap_m=12.0), obstacle_hit=np.array([True])).with_obstacle()
    found = {name: column[0].tolist() for name, column in columns(worlds).items()}
    expected = {
        "gaps_m": [12.0, 5.0],
        "speeds_mps": [0.0, 10.0, 9.0],
        "pair_hit": [True, False],
        "command_mps2": [0.0] * 3,
        "mass_t": [np.inf, 1.0, 1.0],
        "speed_limit_mps": [0.0, 64.0, 64.0],
        "braking_capacity_mps2": [0.0, 16.0, 16.0],
        "driving_capacity_mps2": [0.0, 16.0, 16.0],
        "latency_s": [0.0] * 3,
        "obstacle_gap_m": np.inf,
        "obstacle_hit": False,
    }
    assert {name: found[name] for name in expected} == expected
    assert worlds.vehicles.known_from_s.shape == (1, 3, 3)


def test_packed__ledger_is_that_of_the_columns_of_harm_in_its_own_memory() -> None:
    rows = Packed(np.arange(25.0)[None], np.empty((1, 22)))
    first, total, count, *of_obstacle = rows.ledger()
    rows.state[:] = 5.0
    assert first.tolist() == [[14.0, 15.0]]
    assert total.tolist() == [[16.0, 17.0]]
    assert count.tolist() == [[18, 19]]
    assert [each.tolist() for each in of_obstacle] == [[22.0], [23.0], [24]]
    assert count.dtype == of_obstacle[2].dtype == np.int64
