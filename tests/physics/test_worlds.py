"""Building, selecting and joining worlds."""

from __future__ import annotations

import re
from dataclasses import fields, replace

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds, make_worlds

PARAMETERS = {
    "braking_capacity_mps2": 7.0,
    "driving_capacity_mps2": 4.0,
    "latency_s": 0.5,
    "mass_t": 2.0,
    "speed_limit_mps": 30.0,
    "restitution": 0.1,
}


def build(gaps=((5.0, 6.0),), speeds=((10.0, 11.0, 12.0),), **changed) -> Worlds:
    return make_worlds(gaps, speeds, **{**PARAMETERS, **changed})


def columns(worlds: Worlds) -> dict[str, np.ndarray]:
    """Every array of the worlds and of their vehicles by name."""
    state = {f.name: getattr(worlds, f.name) for f in fields(worlds)[1:]}
    return {**state, **{f.name: getattr(worlds.vehicles, f.name) for f in fields(worlds.vehicles)}}


def numbered(n: int, first: int = 0) -> Worlds:
    """``n`` worlds whose every number tells which world it belongs to."""
    number = np.arange(first, first + n, dtype=np.float64)
    wide = number[:, None]
    worlds = make_worlds(
        wide + np.array([0.25, 0.5]), wide + np.array([1.0, 2.0, 3.0]),
        braking_capacity_mps2=wide + np.array([4.0, 5.0, 6.0]), driving_capacity_mps2=wide + np.array([7.0, 8.0, 9.0]),
        latency_s=wide + 0.125, mass_t=wide + 1.5, speed_limit_mps=wide + 99.0, restitution=number / 1000.0,
    )  # fmt: skip
    hit = np.stack([number % 2 == 0, number % 3 == 0], axis=1)
    news = (wide + np.arange(9.0)).reshape(n, 3, 3)
    worlds = replace(
        worlds, vehicles=replace(worlds.vehicles, own_latency_s=wide + 0.0625 * np.arange(3.0), known_from_s=news)
    )
    return replace(
        worlds,
        time_s=number + 0.75,
        pair_hit=hit,
        command_mps2=wide - [1.0, 2.0, 3.0],
        obstacle_gap_m=number + 40.0,
        obstacle_hit=number % 2 == 1,
    )


def test_make_worlds__starts_at_the_alert_with_nothing_hit_and_nothing_commanded():
    worlds = build()
    assert (worlds.n, worlds.N) == (1, 3)
    assert worlds.time_s.tolist() == [0.0]
    assert worlds.pair_hit.tolist() == [[False, False]] and worlds.pair_hit.dtype == np.bool_
    assert worlds.command_mps2.tolist() == [[0.0, 0.0, 0.0]]


def test_make_worlds__broadcasts_every_parameter_to_its_shape():
    worlds = build(speeds=np.full((4, 3), 10.0), gaps=5.0, mass_t=[1.0, 2.0, 3.0], latency_s=np.full((4, 1), 0.25))
    shapes = {name: column.shape for name, column in columns(worlds).items()}
    wide = {name for name, shape in shapes.items() if shape == (4, 3)}
    assert shapes["gaps_m"] == shapes["pair_hit"] == (4, 2)
    of_worlds = {"time_s", "restitution", "obstacle_gap_m", "obstacle_hit"}
    assert all(shapes[name] == (4,) for name in of_worlds)
    assert wide == set(shapes) - {"gaps_m", "pair_hit", "known_from_s", "messages"} - of_worlds
    assert shapes["known_from_s"] == (4, 3, 3)
    assert worlds.vehicles.mass_t[3].tolist() == [1.0, 2.0, 3.0]
    assert shapes["messages"] == (4, 0)
    own = [column for name, column in columns(worlds).items() if name not in ("known_from_s", "messages")]
    assert all(column.flags.c_contiguous and column.flags.owndata for column in own)
    assert worlds.vehicles.own_latency_s.tolist() == [[0.25] * 3] * 4


def test_known_at_once__takes_no_memory_and_cannot_be_written():
    worlds = build(speeds=np.full((4, 3), 10.0), gaps=5.0, latency_s=[0.0, 0.25, 0.5])
    two = np.array([2, 0])
    some_rows = (worlds.take(two), worlds.take(np.empty(0, np.int64)))
    for some in (worlds, *some_rows, Worlds.concatenate([worlds, worlds]), worlds.assign(two, some_rows[0])):
        news = some.vehicles.known_from_s
        assert news.tolist() == [[[0.0] * 3, [0.25] * 3, [0.5] * 3]] * some.n
        assert some.vehicles.is_known_at_once and (news.strides[2], news.flags.writeable) == (0, False)


def test_is_known_at_once__goes_by_the_numbers():
    vehicles = build(latency_s=[0.0, 0.25, 0.5]).vehicles
    assert replace(vehicles, known_from_s=vehicles.known_from_s.copy()).is_known_at_once
    assert not replace(vehicles, latency_s=vehicles.latency_s + 0.125).is_known_at_once
    assert not replace(vehicles, own_latency_s=vehicles.latency_s - 0.125).is_known_at_once
    late = vehicles.known_from_s.copy()
    late[0, 2, 1] = np.inf
    assert not replace(vehicles, known_from_s=late).is_known_at_once


def test_make_worlds__many_gaps_make_many_worlds_of_one_set_of_speeds():
    worlds = build(gaps=[[1.0, 2.0], [3.0, 4.0]], speeds=[10.0, 11.0, 12.0])
    assert worlds.speeds_mps.tolist() == [[10.0, 11.0, 12.0]] * 2
    assert build(gaps=[1.0, 2.0], speeds=np.full((3, 3), 9.0)).gaps_m.tolist() == [[1.0, 2.0]] * 3


def test_make_worlds__the_speed_limit_defaults_to_40():
    worlds = make_worlds(
        5.0, [1.0, 2.0], braking_capacity_mps2=1, driving_capacity_mps2=0, latency_s=0, mass_t=1, restitution=1
    )
    assert worlds.vehicles.speed_limit_mps.tolist() == [[40.0, 40.0]]


def test_make_worlds__accepts_the_ends_of_every_range():
    worlds = build(gaps=[0.0, 0.0], speeds=[0.0, 30.0, 0.0], driving_capacity_mps2=0.0, latency_s=0.0, restitution=0.0)
    assert worlds.vehicles.restitution.tolist() == [0.0] and worlds.gaps_m.tolist() == [[0.0, 0.0]]
    assert build(restitution=1.0).vehicles.restitution.tolist() == [1.0]
    assert build(obstacle_gap_m=0.0).obstacle_gap_m.tolist() == [0.0]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"gaps": [5.0, -0.5]}, "gaps_m[0, 1] = -0.5: must be finite and in [0, inf]"),
        ({"gaps": [5.0, float("inf")]}, "gaps_m[0, 1] = inf"),
        ({"speeds": [10.0, -1.0, 1.0]}, "speeds_mps[0, 1] = -1: must be finite and in [0, inf]"),
        ({"speeds": [10.0, float("nan"), 1.0]}, "speeds_mps[0, 1] = nan"),
        (
            {"speeds": [[1.0, 2.0, 3.0], [1.0, 2.0, 31.0]]},
            "speeds_mps[1, 2] = 31: above this vehicle's speed_limit_mps 30",
        ),
        ({"speeds": [30.0, 31.0, 1.0]}, "speeds_mps[0, 1] = 31: above this vehicle's speed_limit_mps 30"),
        ({"braking_capacity_mps2": 0.0}, "braking_capacity_mps2[0, 0] = 0: must be finite and in (0, inf]"),
        ({"driving_capacity_mps2": -1.0}, "driving_capacity_mps2[0, 0] = -1: must be finite and in [0, inf]"),
        ({"latency_s": [0.0, 0.0, -0.1]}, "latency_s[0, 2] = -0.1: must be finite and in [0, inf]"),
        ({"mass_t": [1.0, 0.0, 1.0]}, "mass_t[0, 1] = 0: must be finite and in (0, inf]"),
        ({"speed_limit_mps": 0.0}, "speed_limit_mps[0, 0] = 0: must be finite and in (0, inf]"),
        ({"restitution": 1.5}, "restitution[0] = 1.5: must be finite and in [0, 1]"),
        ({"restitution": -0.5}, "restitution[0] = -0.5: must be finite and in [0, 1]"),
        ({"obstacle_gap_m": -0.5}, "obstacle_gap_m[0] = -0.5: must be finite and in [0, inf]"),
        ({"mass_t": [1.0, 2.0]}, "mass_t: shape (2,) does not fit (1, 3)"),
        ({"speeds": [10.0]}, "speeds_mps: shape (1, 1); a line needs at least 2 vehicles, as [n, N]"),
        ({"speeds": np.zeros((1, 1, 3))}, "speeds_mps: shape (1, 1, 3)"),
        ({"speeds": np.zeros((2, 3)), "gaps": np.ones((3, 2))}, "speeds_mps: shape (2, 3) does not fit (3, 3)"),
    ],
)
def test_make_worlds__refuses_with_the_place_and_the_range(changed, message):
    with pytest.raises(InvalidInput, match=re.escape(message)):
        build(**changed)


@pytest.mark.parametrize("rows", [[2, 0], np.array([False, True, True, False])])
def test_take__selects_every_column_and_copies(rows):
    worlds = numbered(4)
    some = worlds.take(rows)
    for name, column in columns(worlds).items():
        taken = columns(some)[name]
        assert taken.tolist() == column[np.asarray(rows)].tolist(), name
        assert not np.shares_memory(taken, column) and taken.flags.c_contiguous


def test_concatenate__is_the_inverse_of_take():
    worlds = numbered(5)
    joined = Worlds.concatenate([worlds.take([0, 1]), worlds.take([2]), worlds.take([3, 4])])
    for name, column in columns(worlds).items():
        assert columns(joined)[name].tolist() == column.tolist(), name


def test_assign__replaces_rows_and_leaves_the_given_worlds_alone():
    worlds, fresh = numbered(4), numbered(2, first=50)
    before = {name: column.tolist() for name, column in columns(worlds).items()}
    result = columns(worlds.assign(np.array([3, 1]), fresh))
    for name, column in columns(worlds).items():
        assert column.tolist() == before[name], name
        expected = column.copy()
        expected[[3, 1]] = columns(fresh)[name]
        assert result[name].tolist() == expected.tolist(), name
