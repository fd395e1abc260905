"""The exact advance: numbers by hand, where doubles end, threads, and forecasts by the same physics."""

import dataclasses
import importlib
import math
from typing import Any

import numba
import numpy as np
import pytest

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.first_edition.physics import jit, motion, segment
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.jit import by_parts
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from tests.first_edition.physics.random_worlds import Draws, driving_lines, line, place_ahead

Events = list[tuple[float, int, float]]


def run(worlds: Worlds, command: Any, *until_s: float) -> tuple[Worlds, list[Impacts]]:
    """Advance to each of these times."""
    parts = []
    for time in until_s:
        worlds, impacts = advance(worlds, command, until_s=time, record=True)
        parts.append(impacts)
    return worlds, parts


def events(parts: list[Impacts]) -> Events:
    """(time, pair, closing speed) of every impact."""
    columns = [(part.rows.time_s, part.rows.pair, part.rows.closing_speed_mps) for part in parts]
    return [(float(t), int(p), float(w)) for each in columns for t, p, w in zip(*each, strict=True)]


# ---------------------------------------------------------------- by hand, in numbers that doubles hold

# The line, its command, the end, (time, pair, closing speed) of each impact, and columns of the state at the end.
# Pair -1 is Vehicle 1 and the obstacle.
CASES: dict[str, tuple[Worlds, Any, float, Events, dict[str, Any]]] = {
    "free motion is quadratic in time": (
        line([10.0], [10.0, 8.0]), [-2.0, -1.0], 2.0, [], {"speeds_mps": [6.0, 6.0], "gaps_m": [12.0]},
    ),
    "a segment of no length changes nothing": (
        line([6.0], [3.0, 8.0]), [-4.0, 4.0], 0.0, [],
        {"speeds_mps": [3.0, 8.0], "gaps_m": [6.0], "command_mps2": [-4.0, 4.0]},
    ),
    "brakes end at standstill and hold": (  # 2 m and 4 m
        line([50.0], [4.0, 4.0]), [-4.0, -2.0], 10.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [48.0]},
    ),
    "a latency ends within the segment": (  # coasts 0.75 s, brakes 1 s
        line([50.0], [8.0, 8.0], latency_s=[0.0, 0.75]), [-2.0, -4.0], 1.75, [],
        {"speeds_mps": [4.5, 4.0], "gaps_m": [50.0 + 8.0 * 1.75 - 1.75**2 - 12.0]},
    ),
    "a command whose latency elapses at the end of the segment never acts": (
        line([8.0], [4.0, 4.0], latency_s=[0.5, 0.75]), [-4.0, -4.0], 0.5, [],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset a rounding error before the end of the segment is at its end": (
        line([8.0], [4.0, 4.0], latency_s=[0.5 - 2.0**-52, 0.75], release_rate_mps3=8.0), [-4.0, -4.0], 0.5, [],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset at the moment of contact comes too late": (
        line([6.0], [0.0, 8.0], latency_s=[0.0, 0.75]), [0.0, -16.0], 0.75, [(0.75, 0, 8.0)],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset releases the front vehicle": (  # joined at 4 m/s; from 0.5 s on the front drives away at 2
        line([0.0], [4.0, 4.0], latency_s=[0.5, 0.0]), [2.0, 0.0], 1.5, [],
        {"speeds_mps": [6.0, 4.0], "gaps_m": [1.0]},
    ),
    "an onset at standstill holds": (  # the rear stops at 1 s; the front, from 1 s on, brakes at rest
        line([8.0], [0.0, 4.0], latency_s=[1.0, 0.0]), [-4.0, -4.0], 3.0, [],
        {"speeds_mps": [0.0, 0.0], "gaps_m": [6.0]},
    ),
    "an impact exchanges speeds as in the paper": (  # v1+ = 3/4 * 1.5 * 8, v2+ = 8 - 1/4 * 1.5 * 8
        line([6.0], [0.0, 8.0], mass_t=[1.0, 3.0], restitution=0.5), 0.0, 1.0, [(0.75, 0, 8.0)],
        {"speeds_mps": [9.0, 5.0], "gaps_m": [1.0], "pair_hit": [True]},
    ),
    "a contact at the start happens at once": (
        line([0.0], [0.0, 8.0]), 0.0, 0.0, [(0.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "standstill exactly at the bumper is a touch": (  # 8 m/s, braking at 4: 2 s and 8 m
        line([8.0], [0.0, 8.0], restitution=0.5), [-4.0, -4.0], 4.0, [],
        {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0], "pair_hit": [False]},
    ),
    "standstill of both at the moment they touch": (  # 2 m and 4 m in 1 s
        line([2.0], [4.0, 8.0], restitution=0.5), [-4.0, -8.0], 3.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0]},
    ),
    "equal speeds at the bumper are a touch": (  # w^2 = 2 q g
        line([4.0], [10.0, 14.0]), [0.0, -2.0], 2.0, [], {"speeds_mps": [10.0, 10.0], "gaps_m": [0.0]},
    ),
    "standstill of the front vehicle when it is struck": (  # it stops after 1 s and 2 m; 8 m in that second
        line([6.0], [4.0, 8.0]), [-4.0, 0.0], 1.0, [(1.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "thrown back, its brakes end the negative speed": (  # P = 2: front 3, rear -1, at rest after 0.5 s
        line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, -2.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, 0.0], "gaps_m": [6.25]},
    ),
    "thrown back, it coasts on": (
        line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), 0.0, 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, -1.0], "gaps_m": [8.0]},
    ),
    "thrown back, it drives forward again": (  # from -1 at +2: stands after 0.5 s
        line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, 2.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, 3.0], "gaps_m": [4.0]},
    ),
    "a drive ends at the limit": (
        line([50.0], [8.0, 0.0], speed_limit_mps=10.0), [2.0, 0.0], 3.0, [],
        {"speeds_mps": [10.0, 0.0], "gaps_m": [79.0]},
    ),
    "the limit is reached at the moment of contact": (  # 4 to 8 m/s at 4 in 1 s, 6 m
        line([6.0], [0.0, 4.0], speed_limit_mps=8.0), [0.0, 4.0], 1.0, [(1.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "the limit of the rear vehicle ends its push": (  # +2 each from 4 to 6 after 1 s
        line([0.0], [4.0, 4.0], speed_limit_mps=[64.0, 6.0]), [0.0, 4.0], 3.0, [],
        {"speeds_mps": [6.0, 6.0], "gaps_m": [0.0]},
    ),
    "a driver at its limit holds it against a braking front vehicle": (
        line([0.0], [8.0, 8.0], speed_limit_mps=[64.0, 8.0]), [-2.0, 6.0], 2.0, [], {"speeds_mps": [8.0, 8.0]},
    ),
    "a driver at its limit gives all it has and no more": (  # (-10 + 6) / 2
        line([0.0], [8.0, 8.0], speed_limit_mps=[64.0, 8.0]), [-10.0, 6.0], 2.0, [], {"speeds_mps": [4.0, 4.0]},
    ),
    "struck beyond its limit it coasts": (
        line([0.0], [8.0, 16.0], speed_limit_mps=[8.0, 64.0]), [4.0, 0.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [12.0, 12.0]},
    ),
    "pushed as hard as it holds it stands": (
        line([0.0], [0.0, 0.0], mass_t=2.0), [-4.0, 4.0], 1.0, [], {"speeds_mps": [0.0, 0.0]},
    ),
    "pushed harder than it holds it moves": (  # (2 * 6 - 8) / 4
        line([0.0], [0.0, 0.0], mass_t=2.0), [-4.0, 6.0], 1.0, [], {"speeds_mps": [1.0, 1.0]},
    ),
    "two braked members hold together": (  # 8 + 4 kN against 12
        line([0.0, 0.0], [0.0] * 3, mass_t=[4.0, 1.0, 3.0]), [-2.0, -4.0, 4.0], 2.0, [], {"speeds_mps": [0.0] * 3},
    ),
    "two braked members give way together": (  # (24 - 12) / 8
        line([0.0, 0.0], [0.0] * 3, mass_t=[4.0, 1.0, 3.0]), [-2.0, -4.0, 8.0], 2.0, [], {"speeds_mps": [3.0] * 3},
    ),
    "a moving block stops and then holds": (  # 2 t at -4 and 2 t at +2: block -1
        line([0.0], [4.0, 4.0], mass_t=2.0), [-4.0, 2.0], 9.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0]},
    ),
    "a block shares by mass": (  # 1 t at -8 before 3 t at 0
        line([0.0], [8.0, 8.0], mass_t=[1.0, 3.0]), [-8.0, 0.0], 1.0, [], {"speeds_mps": [6.0, 6.0]},
    ),
    "only the pressing part of a line is a block": (  # (-4 * 1 + 4 * 3) / 4
        line([0.0, 0.0], [8.0] * 3, mass_t=[1.0, 1.0, 3.0]), [4.0, -4.0, 4.0], 1.0, [],
        {"speeds_mps": [12.0, 10.0, 10.0], "gaps_m": [1.0, 0.0]},
    ),
    "two pairs apart from each other meet at one instant": (
        line([6.0, 99.0, 6.0], [0.0, 8.0, 0.0, 8.0]), 0.0, 0.75, [(0.75, 0, 8.0), (0.75, 2, 8.0)],
        {"speeds_mps": [4.0] * 4},
    ),
    "neighbouring pairs meet at one instant, in no order": (  # P = (4 + 8) / 4; v+ = 4.5 - 0.5 v
        line([2.0, 6.0], [0.0, 2.0, 8.0], mass_t=[1.0, 2.0, 1.0], restitution=0.5), 0.0, 1.0,
        [(1.0, 0, 2.0), (1.0, 1, 6.0)], {"speeds_mps": [4.5, 3.5, 0.5]},
    ),
    "the rear of three is struck: the law takes all three": (  # P = 9 / 3: v+ = 4.5 - 0.5 v
        line([0.0, 0.0], [0.0, 0.0, 9.0], restitution=0.5), 0.0, 0.0, [(0.0, 1, 9.0)], {"speeds_mps": [4.5, 4.5, 0.0]},
    ),
    "a pair that opens is left out": (  # P = 6, 6, 4
        line([0.0, 0.0], [4.0, 8.0, 4.0], restitution=0.5), 0.0, 0.0, [(0.0, 0, 4.0)], {"speeds_mps": [7.0, 5.0, 4.0]},
    ),
    "a second round at the same instant counts again": (  # P = 22 / 4: 8.25, 4.25, 4.75; then 2 and 3 at 0.5
        line([0.0, 0.0], [0.0, 8.0, 7.0], mass_t=[1.0, 1.0, 2.0], restitution=0.5), 0.0, 0.0,
        [(0.0, 0, 8.0), (0.0, 1, 0.5)], {"speeds_mps": [8.25, 4.75, 4.5]},
    ),
    "bounces without loss go on at a steady pace": (  # every flight lasts 2 * 8 / 4 s
        line([0.0], [0.0, 8.0], mass_t=[2.0**60, 1.0], restitution=1.0), [-16.0, 4.0], 15.0,
        [(0.0, 0, 8.0), (4.0, 0, 8.0), (8.0, 0, 8.0), (12.0, 0, 8.0)], {"speeds_mps": [0.0, 4.0]},
    ),
    "an obstacle throws back": (  # 10 m at 20 m/s; v+ = -0.5 * 20; 5 m away again
        line([50.0], [20.0, 0.0], mass_t=[3.0, 1.0], restitution=0.5, obstacle_gap_m=10.0), 0.0, 1.0, [(0.5, -1, 20.0)],
        {"speeds_mps": [-10.0, 0.0], "gaps_m": [55.0], "obstacle_gap_m": 5.0, "obstacle_hit": True},
    ),
    "an obstacle is struck again": (  # thrown back at 5, its motor turns it round
        line([99.0], [10.0, 0.0], restitution=0.5, obstacle_gap_m=0.0), [4.0, 0.0], 3.0,
        [(0.0, -1, 10.0), (2.5, -1, 5.0)], {"speeds_mps": [-0.5, 0.0]},
    ),
    "an obstacle takes 2 a g off the squared speed": (  # 400 - 12 * 28
        line([99.0], [20.0, 0.0], restitution=0.0, obstacle_gap_m=28.0), [-6.0, 0.0], 8.0, [(2.0, -1, 8.0)],
        {"speeds_mps": [0.0, 0.0], "obstacle_gap_m": 0.0},
    ),
    "an obstacle out of the way of the brakes is not met": (  # 33.33 m
        line([99.0], [20.0, 0.0], obstacle_gap_m=33.5), [-6.0, 0.0], 8.0, [], {"obstacle_hit": False},
    ),
    "an obstacle below the plastic speed ends the motion": (
        line([99.0], [0.04, 0.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 1.0, [(0.0, -1, 0.04)],
        {"speeds_mps": [0.0, 0.0], "obstacle_hit": True},
    ),
    "an obstacle at the touch speed is not struck": (
        line([99.0], [1e-5, 0.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 1.0, [],
        {"speeds_mps": [0.0, 0.0], "obstacle_hit": False},
    ),
    "an obstacle and who leans on it stay when struck": (  # P of (0, 10) bounded by 0 is (0, 0): v+ = -e v-
        line([0.0], [0.0, 10.0], mass_t=[1.0, 100.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 0.0, [(0.0, 0, 10.0)],
        {"speeds_mps": [0.0, -5.0], "obstacle_hit": False},
    ),
    "an obstacle ends a plastic chain in one round": (
        line([0.0, 0.0], [6.0, 8.0, 10.0], obstacle_gap_m=0.0), 0.0, 0.0,
        [(0.0, -1, 6.0), (0.0, 0, 2.0), (0.0, 1, 2.0)], {"speeds_mps": [0.0] * 3},
    ),
    **{
        f"an obstacle holds a line that presses with {command}": (
            line([0.0, 0.0], [0.0] * 3, restitution=0.5, obstacle_gap_m=0.0), command, 5.0, [],
            {"speeds_mps": [0.0] * 3, "gaps_m": [0.0] * 2, "obstacle_gap_m": 0.0, "obstacle_hit": False},
        )
        for command in ([6.0, 6.0, 6.0], [-6.0, 6.0, 6.0], [0.0, -6.0, 6.0], [0.0, 0.0, 6.0])
    },
}  # fmt: skip


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_advance__by_hand(name: str, cut: bool) -> None:
    worlds, command, end, expected, state = CASES[name]
    after, parts = run(worlds, command, *(np.arange(0.25, end, 0.25).tolist() if cut else []), end)
    assert events(parts) == expected
    assert {name: getattr(after, name).tolist() for name in state} == {name: [value] for name, value in state.items()}


# ---------------------------------------------------------------- where doubles end


@pytest.mark.parametrize(("onset", "end"), [(0.4, 1.45), (0.12, 1.3)])
def test_end__that_an_event_reaches_is_the_end_itself(onset: float, end: float) -> None:
    # 1 m/s over `end` metres; the onset cuts the way in two, whose doubles add up to a little less or more than `end`
    assert onset + (end - onset) != end
    assert events(run(line([end], [0.0, 1.0], latency_s=[0.0, onset]), 0.0, end)[1]) == [(end, 0, 1.0)]


@pytest.mark.parametrize("limit", [5.6, 6.1, 6.6])
def test_block__takes_the_limit_of_any_of_its_members_to_the_last_bit(limit: float) -> None:
    # 6 t coasting, pushed by 1 t at +1: a block at +1/7, until its rear vehicle is at its limit; the doubles of
    # speed + acceleration * time end a little beyond it
    assert 1.0 + 1.0 / 7.0 * ((limit - 1.0) / (1.0 / 7.0)) > limit
    after, _ = advance(line([0.0], [1.0, 1.0], mass_t=[6.0, 1.0], speed_limit_mps=[64.0, limit]), [0.0, 1.0], 60.0)
    assert after.speeds_mps.tolist() == [[limit, limit]] and after.gaps_m.tolist() == [[0.0]]


@pytest.mark.parametrize("gap", [-1.5e-9, -2e-9])  # beyond: `test_refusals.py`
def test_overlap__at_an_event_is_rounding_up_to_1e_9_m(gap: float) -> None:
    # vehicle 1 leaves vehicle 2 with 1e-9 m/s; vehicle 3 meets them after 1 s, when 1e-9 m of the overlap are gone
    worlds = dataclasses.replace(line([0.0, 8.0], [1e-9, 0.0, 8.0]), gaps_m=np.array([[gap, 8.0]]))
    after, impacts = advance(worlds, 0.0, 1.0)
    assert impacts.count.tolist() == [[0, 1]] and (after.gaps_m == 0.0).all()


@pytest.mark.parametrize(
    ("closing", "count", "apart"),
    [
        (0.5e-5, 0, 0.0),
        (1e-5, 0, 0.0),
        (math.nextafter(1e-5, 1.0), 1, 0.0),
        (0.03125, 1, 0.0),
        (0.05, 1, 0.025),
        (0.0625, 1, 0.03125),
    ],
)
def test_pair__touches_up_to_1e_5_and_joins_below_5_cm_per_s(closing: float, count: int, apart: float) -> None:
    after, impacts = advance(line([0.0], [0.0, closing], restitution=0.5), 0.0, 0.0)
    assert (impacts.count[0, 0], impacts.total_harm[0, 0], after.pair_hit[0, 0]) == (count, count * closing**2, count)
    front, rear = after.speeds_mps[0]
    assert front - rear == pytest.approx(apart, rel=1e-15) and front + rear == pytest.approx(closing, rel=1e-15)


# ---------------------------------------------------------------- many impacts


@pytest.mark.parametrize("e", [0.125, 0.25, 0.5, 0.75, 0.875])
def test_bounces__end_after_the_sum_of_their_flights(e: float) -> None:
    # rear presses with 4 on a holding wall: bounces 8, 8e, 8e^2, ... down to the first below 0.05, which is plastic
    closing = [8.0]
    while closing[-1] >= 0.05:
        closing.append(closing[-1] * e)
    flights = sum(2.0 * w / 4.0 for w in closing[1:])
    after, parts = run(line([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=e), [-16.0, 4.0], 60.0)
    assert [w for *_, w in events(parts)] == pytest.approx(closing, rel=1e-10)
    assert events(parts)[-1][0] == pytest.approx(flights, rel=1e-12)
    assert after.gaps_m.tolist() == [[0.0]] and after.speeds_mps[0, 1] == pytest.approx(0.0, abs=1e-12)


def test_bounces__of_three_pressing_vehicles_end_in_contact() -> None:
    draws, n = Draws(8), 300
    start = line(
        np.zeros((n, 2)), draws.uniform(0, 12, (n, 3)), mass_t=draws.uniform(1, 8, (n, 3)),
        restitution=draws.uniform(0.0, 0.95, (n,)),
    )  # fmt: skip
    after, (impacts,) = run(start, np.tile([-16.0, 0.0, 4.0], (n, 1)), 300.0)
    assert impacts.count.max() > 20
    assert np.all(after.gaps_m == 0.0) and np.all(after.speeds_mps == after.speeds_mps[:, :1])


def test_bounces__more_than_any_segment_holds_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    # e = 1 and a push of 10 m/s2 against a heavy wall: a bounce of 0.2 m/s every 0.04 s for 50,000 s
    if numba.config.DISABLE_JIT:  # a million events would take long
        monkeypatch.setattr(segment, "BOUND", motion.BOUND._replace(MOST_EVENTS=50))
    wall = line([0.0], [0.0, 0.2], mass_t=[2.0**60, 1.0], restitution=1.0)
    most = motion.BOUND.MOST_EVENTS
    with pytest.raises(PhysicsError, match=f"world 0: there were more than {most:,} events between 0 s and 50000 s"):
        advance(wall, [-10.0, 10.0], 50_000.0)


def test_impacts__are_listed_on_demand_in_a_list_that_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    module, runs = importlib.import_module("ethbrake_marl.first_edition.physics.advance"), []
    monkeypatch.setattr(module, "by_parts", lambda *given: runs.append(given) or by_parts(*given))
    wall = line([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=1.0)  # a bounce each second
    for until, needed in ((10.5, 1), (129.5, 2)):
        runs.clear()
        rows = advance(wall, [-16.0, 16.0], until, record=True)[1].rows
        assert rows.time_s == pytest.approx(np.arange(until), abs=1e-9) and len(runs) == needed
    assert advance(wall, [-16.0, 16.0], 129.5)[1].rows is None


# ---------------------------------------------------------------- threads


@pytest.mark.parametrize("threads", [2, 3, np.int64(2), 500])
def test_threads__give_the_same_bits_and_the_same_impacts_in_the_same_order(threads: int) -> None:
    worlds = load_scenario("paper-random").sample(101, 7).worlds
    command = -0.75 * worlds.vehicles.braking_capacity_mps2
    one, several = (advance(worlds, command, 8.0, record=True, threads=k) for k in (1, threads))
    assert len(one[1].rows.world) > 100
    for mine, its in zip((*several, several[1].rows), (*one, one[1].rows), strict=True):
        for name in {field.name for field in dataclasses.fields(its)} - {"vehicles", "rows"}:
            np.testing.assert_array_equal(getattr(mine, name), getattr(its, name), err_msg=name, strict=True)


def test_threads__one_is_the_default_and_starts_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "ThreadPoolExecutor", None)
    assert advance(line([9.0], [4.0, 4.0]), 0.0, 1.0)[0].time_s.tolist() == [1.0]


def test_threads__record_more_impacts_than_expected_in_one_part_only() -> None:
    # Ten standing vehicles behind each other, and a fast one behind: each impact sets off the next one.
    chain = line(
        np.full((40, 9), 1.0), np.r_[np.zeros(9), 30.0] * np.ones((40, 1)),
        restitution=np.r_[np.zeros(20), np.full(20, 0.5)],
    )  # fmt: skip
    serial, parallel = (advance(chain, 0.0, 9.0, record=True, threads=k)[1].rows for k in (1, 2))
    assert (serial.world >= 20).sum() > 4 * 40 + 64
    assert (parallel.world == serial.world).all() and (parallel.time_s == serial.time_s).all()


# ---------------------------------------------------------------- forecasts


@pytest.mark.parametrize("vehicle", [0, 1, 2])
@pytest.mark.parametrize("until", [2.0, 3.5, 8.0])
def test_forecast__is_the_harm_of_the_advance_bit_for_bit(vehicle: int, until: float) -> None:
    plain, ahead = driving_lines(166, 40, 3), place_ahead(driving_lines(167, 40, 3), 168, high=15.0)
    worlds, command = Worlds.concatenate([plain.worlds, ahead.worlds]), np.concatenate([plain.command, ahead.command])
    worlds, _ = advance(worlds, command, until_s=Draws(11).uniform(0.0, 3.0, (80,)))
    worlds, command = worlds.take(worlds.time_s < until), command[worlds.time_s < until]
    candidates = np.tile([-8.0, -4.0, 0.0, 8.0], (worlds.n, 1))
    first, total = forecast(worlds, np.where(np.arange(3) == vehicle, 99.0, command), vehicle, candidates, until)
    for c in range(4):
        command[:, vehicle] = candidates[:, c]
        impacts = advance(worlds, command, until_s=until)[1]
        parts = np.column_stack([impacts.obstacle_first_harm, impacts.first_impact_harm])
        assert first[:, c].tolist() == parts.sum(axis=1).tolist()
        parts = np.column_stack([impacts.obstacle_total_harm, impacts.total_harm])
        assert total[:, c].tolist() == parts.sum(axis=1).tolist()
    assert (first > 0.0).sum() > 30 and (total > first).sum() > 3


@pytest.mark.parametrize(("until", "harm"), [(-1.0, 0.0), (0.0, 0.0), (1e-3, 64.0)])
def test_forecast__an_impact_that_is_due_counts_only_before_the_horizon(until: float, harm: float) -> None:
    assert forecast(line([[0.0]], [0.0, 8.0]), np.zeros((1, 2)), 0, np.zeros((1, 1)), until)[0].tolist() == [[harm]]


def test_contact__one_double_before_the_end_of_a_segment_and_one_after() -> None:
    worlds = line([6.0], [0.0, 8.0])
    before, after = math.nextafter(0.75, 0.0), math.nextafter(0.75, 1.0)
    counts = [[int(part.count[0, 0]) for part in run(worlds, 0.0, *times)[1]] for times in ([before], [after])]
    assert counts == [[0], [1]]
    assert [int(part.count[0, 0]) for part in run(worlds, 0.0, before, 0.75, 1.0)[1]] == [0, 1, 0]


def test_impact__of_speeds_below_the_range_of_doubles_moves_by_less_than_their_spacing() -> None:
    # 5e-324 m/s has no half: relative tolerances end at SMALLEST, nothing else happens
    after, impacts = advance(line([0.0], (0.0, 5e-324), restitution=0.5), 0.0, 0.0)
    front, rear = after.speeds_mps[0]
    assert impacts.count.tolist() == [[0]]
    assert after.gaps_m.tolist() == [[0.0]]
    assert 0.0 <= front == rear <= 5e-324


def test_plastic_cluster__of_three_does_not_hand_the_last_bit_to_and_fro() -> None:
    # The regression joins all three at one speed, whose refined double is 1 ulp off for two of them; in doubles the
    # rear two then approach the front one again, and so on for ever.
    speeds = [float.fromhex(f"0x1.66d388ecfa50{digit}p+0") for digit in (5, 7, 6)]
    mass = [float.fromhex(each) for each in ("0x1.38aa48a631a58p+4", "0x1.842a10bbca148p+2", "0x1.e8de440211adfp+3")]
    after, impacts = advance(line([0.0, 0.0], speeds, mass_t=mass, restitution=0.1), 0.0, 0.0)
    assert np.all(np.diff(after.speeds_mps) <= 0.0)
    assert impacts.count.sum() == 0
    assert after.speeds_mps[0] == pytest.approx(speeds, rel=4e-16)
