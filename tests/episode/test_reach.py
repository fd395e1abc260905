"""Who cannot come near an observer before the end reads as absent: by hand, bit by bit, and against what happens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.episode import features
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.reach import within_reach
from ethbrake_marl.episode.state import END, State, mark
from ethbrake_marl.motion import layout as at
from tests.episode.lines import later, state_of
from tests.motion.lines import driven

USUAL = {"braking_capacity_mps2": 6.0, "driving_capacity_mps2": 6.0, "restitution": 0.1, "mass_t": 5.0}


def ending(state: State, end_s: float) -> State:
    clock = state.clock.copy()
    clock[:, END] = end_s
    return state._replace(clock=clock)


def row(
    gaps_m: list[float], speeds_mps: list[float], *, body: int = 2, end_s: float = 8.0, **settings: Any
) -> list[int]:
    """First and last vehicle that can matter to ``body``, at the alert."""
    return within_reach(ending(state_of(gaps_m, speeds_mps, **USUAL | settings), end_s), body)[0].tolist()


@pytest.mark.parametrize(
    ("gap_m", "changes", "last"),
    [
        (161.0, {}, 3),  # 20 m/s for 8 s: 160 m
        (159.0, {}, 4),
        (200.0, {"end_s": 10.1}, 4),  # 202 m
        (101.0, {"end_s": 0.1}, 3),
        (100.0, {"end_s": 0.1}, 4),  # as near as features show
        (200.0, {"mass_t": [5.0, 5.0, 5.0, 60.0]}, 3),  # a truck alone behind the gap
        (200.0, {"mass_t": [60.0, 5.0, 5.0, 5.0]}, 4),  # ahead of it Vehicle 2 may bounce back from a truck
        (200.0, {"mass_t": [60.0, 5.0, 5.0, 5.0], "restitution": 0.0}, 3),
        (200.0, {"obstacle_gap_m": 50.0}, 4),  # or Vehicle 1 from an obstacle
        (200.0, {"obstacle_gap_m": 50.0, "restitution": 0.0}, 3),
        (200.0, {"mass_t": [5.0, 5.0, 5.0, np.nan]}, 3),
        (200.0, {"mass_t": [5.0, 5.0, np.nan, 5.0]}, 4),  # unknown: it may be a truck
    ],
)
def test_rule__by_hand(gap_m: float, changes: dict[str, Any], last: int) -> None:
    assert row([8.0, 6.0, gap_m], [20.0] * 4, **changes) == [1, last]


def test_truck_behind__may_throw_a_car_across_the_gap() -> None:
    speeds = {"speeds_mps": [20.0] * 4, "body": 1}
    assert row([200.0, 5.0, 5.0], **speeds, mass_t=[5.0, 5.0, 5.0, 5.0]) == [1, 1]
    assert row([200.0, 5.0, 5.0], **speeds, mass_t=[5.0, 1.5, 40.0, 5.0]) == [1, 4]


def test_who_drives__may_reach_its_speed_limit_except_the_observer() -> None:
    state = ending(state_of([8.0, 6.0, 200.0], [20.0] * 4, **USUAL), 8.0)
    for driving, expected in ((4, [1, 4]), (3, [1, 3]), (2, [1, 3])):
        line = state.line.copy()
        line[:, at.FORCE, driving] = 1.0
        assert within_reach(state._replace(line=line), 2)[0].tolist() == expected
    line[:, at.FORCE, 4] = np.nan  # unknown
    assert within_reach(state._replace(line=line), 4)[0].tolist() == [4, 4]
    assert within_reach(state._replace(line=line), 2)[0].tolist() == [1, 4]


def test_other_physics__may_bring_anybody_near() -> None:
    """In that of the package, Vehicle 4 is too far away to matter to Vehicle 2."""
    state = ending(state_of([8.0, 6.0, 200.0], [20.0] * 4, **USUAL), 8.0)
    view, marked = View(["rear_2.known", "role.vehicles_behind"]), mark(state, ["wind"])
    assert within_reach(state, 2)[0].tolist() == [1, 3] and within_reach(marked, 2)[0].tolist() == [1, 4]
    seen = [view.observe(each, np.array([2]), 0.1)[0, 0].tolist() for each in (state, marked)]
    assert seen[0][0] == 0.0 and seen[1][0] == 1.0 and seen[0][1] < seen[1][1]


def test_who_is_unknown__may_be_fast() -> None:
    state = ending(state_of([8.0, 200.0, 6.0], [20.0] * 4, **USUAL), 8.0)
    know = state.know.copy()
    assert within_reach(state, 2)[0].tolist() == [1, 2]
    know[:, 2, 4] = np.inf
    assert within_reach(state._replace(know=know), 2)[0].tolist() == [1, 4]


GROUPS = [
    "own",
    "front_1",
    "front_2",
    "rear_1",
    "rear_2",
    "role",
    "obstacle",
    "front_2.build_up_time",
    "rear_2.release_time",
]


@pytest.mark.parametrize("groups", [GROUPS, ["contact", "plan"]])
@pytest.mark.parametrize("until_s", [0.5, 1.5, 3.0])
def test_far_vehicles__change_no_bit_of_what_is_observed(until_s: float, groups: list[str]) -> None:
    if groups is not GROUPS and not {*groups} <= {*features.GROUPS}:
        pytest.skip("no forecasts here")
    view, rng = View(groups), np.random.default_rng(5)
    near, speeds = rng.uniform(5.0, 10.0, (50, 2)), rng.uniform(18.0, 22.0, (50, 5))
    far, close = np.full((50, 1), 200.0), np.full((50, 1), 8.0)

    def seen(gaps: Any, vehicles: slice, body: int) -> bytes:
        state = state_of(np.hstack(gaps), speeds[:, vehicles], **USUAL)
        state = ending(later(state, np.full((50, state.vehicles), -5.5), until_s), 8.0)
        return view.observe(state, np.array([body]), 0.1).tobytes()

    alone = seen([near], slice(1, 4), 2)
    assert seen([far, near], slice(0, 4), 3) == alone
    assert seen([near, far], slice(1, 5), 2) == alone
    assert seen([far, near, far], slice(0, 5), 3) == alone
    assert seen([close, near], slice(0, 4), 3) != alone
    assert seen([near, close], slice(1, 5), 2) != alone


def test_apart__means_that_the_two_do_not_meet() -> None:
    rng, n, end_s = np.random.default_rng(3), 4_000, 8.0
    gaps = rng.uniform(0.5, 30.0, (n, 3))
    middle = np.arange(n) % 3
    gaps[np.arange(n), middle] = rng.uniform(90.0, 400.0, n)
    state = state_of(
        gaps, rng.uniform(0.0, 40.0, (n, 4)), restitution=rng.uniform(0.0, 0.9, n), braking_capacity_mps2=6.0,
        mass_t=np.exp(rng.uniform(0.0, 3.5, (n, 4))),
    )  # fmt: skip
    commands = np.where(rng.random((n, 4)) < 0.5, 0.0, -rng.uniform(0.0, 60.0, (n, 4)))
    line, _, _ = driven(state.line, state.car, commands, state.time_s, end_s)
    last = within_reach(ending(state, end_s), 1)[:, 1]
    apart = (last == middle + 1) & (gaps[np.arange(n), middle] > 100.0)
    assert 300 < apart.sum() < n - 300
    assert (line[np.arange(n), at.HIT, middle + 1][apart] == 0.0).all()
    assert (line[np.arange(n), at.HIT, middle + 1][~apart] == 1.0).sum() > 100
