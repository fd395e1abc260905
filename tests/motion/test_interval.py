"""The motion of one line: numbers by hand, where doubles end, many impacts."""

import math
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.forces import stopping_distances
from ethbrake_marl.motion.interval import EVENT_BY_EVENT, FAILED
from ethbrake_marl.motion.layout import Floats
from tests.motion.lines import driven, lines

Events = list[tuple[float, int, float]]

# The line, its command, the end, (time, pair, closing speed) of each impact, and what holds at the end. Pair -1 is
# Vehicle 1 and the obstacle.
CASES: dict[str, tuple[Any, Any, float, Events, dict[str, Any]]] = {
    "free motion is quadratic in time": (
        lines([10.0], [10.0, 8.0]), [-2.0, -1.0], 2.0, [], {"speeds_mps": [6.0, 6.0], "gaps_m": [12.0]},
    ),
    "a segment of no length changes nothing": (
        lines([6.0], [3.0, 8.0]), [-4.0, 4.0], 0.0, [],
        {"speeds_mps": [3.0, 8.0], "gaps_m": [6.0], "command_mps2": [-4.0, 4.0]},
    ),
    "brakes end at standstill and hold": (  # 2 m and 4 m
        lines([50.0], [4.0, 4.0]), [-4.0, -2.0], 10.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [48.0]},
    ),
    "a latency ends within the segment": (  # coasts 0.75 s, brakes 1 s
        lines([50.0], [8.0, 8.0], latency_s=[0.0, 0.75]), [-2.0, -4.0], 1.75, [],
        {"speeds_mps": [4.5, 4.0], "gaps_m": [50.0 + 8.0 * 1.75 - 1.75**2 - 12.0]},
    ),
    "a command whose latency elapses at the end of the segment never acts": (
        lines([8.0], [4.0, 4.0], latency_s=[0.5, 0.75]), [-4.0, -4.0], 0.5, [],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset a rounding error before the end of the segment is at its end": (
        lines([8.0], [4.0, 4.0], latency_s=[0.5 - 2.0**-52, 0.75], release_rate_mps3=8.0), [-4.0, -4.0], 0.5, [],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset at the moment of contact comes too late": (
        lines([6.0], [0.0, 8.0], latency_s=[0.0, 0.75]), [0.0, -16.0], 0.75, [(0.75, 0, 8.0)],
        {"speeds_mps": [4.0, 4.0], "command_mps2": [0.0, 0.0]},
    ),
    "an onset releases the front vehicle": (  # joined at 4 m/s; from 0.5 s on the front drives away at 2
        lines([0.0], [4.0, 4.0], latency_s=[0.5, 0.0]), [2.0, 0.0], 1.5, [],
        {"speeds_mps": [6.0, 4.0], "gaps_m": [1.0]},
    ),
    "an onset at standstill holds": (  # the rear stops at 1 s; the front, from 1 s on, brakes at rest
        lines([8.0], [0.0, 4.0], latency_s=[1.0, 0.0]), [-4.0, -4.0], 3.0, [],
        {"speeds_mps": [0.0, 0.0], "gaps_m": [6.0]},
    ),
    "an impact exchanges speeds as in the paper": (  # v1+ = 3/4 * 1.5 * 8, v2+ = 8 - 1/4 * 1.5 * 8
        lines([6.0], [0.0, 8.0], mass_t=[1.0, 3.0], restitution=0.5), 0.0, 1.0, [(0.75, 0, 8.0)],
        {"speeds_mps": [9.0, 5.0], "gaps_m": [1.0], "pair_hit": [True]},
    ),
    "a contact at the start happens at once": (
        lines([0.0], [0.0, 8.0]), 0.0, 0.0, [(0.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "standstill exactly at the bumper is a touch": (  # 8 m/s, braking at 4: 2 s and 8 m
        lines([8.0], [0.0, 8.0], restitution=0.5), [-4.0, -4.0], 4.0, [],
        {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0], "pair_hit": [False]},
    ),
    "standstill of both at the moment they touch": (  # 2 m and 4 m in 1 s
        lines([2.0], [4.0, 8.0], restitution=0.5), [-4.0, -8.0], 3.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0]},
    ),
    "equal speeds at the bumper are a touch": (  # w^2 = 2 q g
        lines([4.0], [10.0, 14.0]), [0.0, -2.0], 2.0, [], {"speeds_mps": [10.0, 10.0], "gaps_m": [0.0]},
    ),
    "standstill of the front vehicle when it is struck": (  # it stops after 1 s and 2 m; 8 m in that second
        lines([6.0], [4.0, 8.0]), [-4.0, 0.0], 1.0, [(1.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "thrown back, its brakes end the negative speed": (  # P = 2: front 3, rear -1, at rest after 0.5 s
        lines([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, -2.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, 0.0], "gaps_m": [6.25]},
    ),
    "thrown back, it coasts on": (
        lines([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), 0.0, 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, -1.0], "gaps_m": [8.0]},
    ),
    "thrown back, it drives forward again": (  # from -1 at +2: stands after 0.5 s
        lines([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, 2.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [3.0, 3.0], "gaps_m": [4.0]},
    ),
    "a drive ends at the limit": (
        lines([50.0], [8.0, 0.0], speed_limit_mps=10.0), [2.0, 0.0], 3.0, [],
        {"speeds_mps": [10.0, 0.0], "gaps_m": [79.0]},
    ),
    "the limit is reached at the moment of contact": (  # 4 to 8 m/s at 4 in 1 s, 6 m
        lines([6.0], [0.0, 4.0], speed_limit_mps=8.0), [0.0, 4.0], 1.0, [(1.0, 0, 8.0)], {"speeds_mps": [4.0, 4.0]},
    ),
    "the limit of the rear vehicle ends its push": (  # +2 each from 4 to 6 after 1 s
        lines([0.0], [4.0, 4.0], speed_limit_mps=[64.0, 6.0]), [0.0, 4.0], 3.0, [],
        {"speeds_mps": [6.0, 6.0], "gaps_m": [0.0]},
    ),
    "a driver at its limit holds it against a braking front vehicle": (
        lines([0.0], [8.0, 8.0], speed_limit_mps=[64.0, 8.0]), [-2.0, 6.0], 2.0, [], {"speeds_mps": [8.0, 8.0]},
    ),
    "a driver at its limit gives all it has and no more": (  # (-10 + 6) / 2
        lines([0.0], [8.0, 8.0], speed_limit_mps=[64.0, 8.0]), [-10.0, 6.0], 2.0, [], {"speeds_mps": [4.0, 4.0]},
    ),
    "struck beyond its limit it coasts": (
        lines([0.0], [8.0, 16.0], speed_limit_mps=[8.0, 64.0]), [4.0, 0.0], 2.0, [(0.0, 0, 8.0)],
        {"speeds_mps": [12.0, 12.0]},
    ),
    "pushed as hard as it holds it stands": (
        lines([0.0], [0.0, 0.0], mass_t=2.0), [-4.0, 4.0], 1.0, [], {"speeds_mps": [0.0, 0.0]},
    ),
    "pushed harder than it holds it moves": (  # (2 * 6 - 8) / 4
        lines([0.0], [0.0, 0.0], mass_t=2.0), [-4.0, 6.0], 1.0, [], {"speeds_mps": [1.0, 1.0]},
    ),
    "two braked members hold together": (  # 8 + 4 kN against 12
        lines([0.0, 0.0], [0.0] * 3, mass_t=[4.0, 1.0, 3.0]), [-2.0, -4.0, 4.0], 2.0, [], {"speeds_mps": [0.0] * 3},
    ),
    "two braked members give way together": (  # (24 - 12) / 8
        lines([0.0, 0.0], [0.0] * 3, mass_t=[4.0, 1.0, 3.0]), [-2.0, -4.0, 8.0], 2.0, [], {"speeds_mps": [3.0] * 3},
    ),
    "a moving block stops and then holds": (  # 2 t at -4 and 2 t at +2: block -1
        lines([0.0], [4.0, 4.0], mass_t=2.0), [-4.0, 2.0], 9.0, [], {"speeds_mps": [0.0, 0.0], "gaps_m": [0.0]},
    ),
    "a block shares by mass": (  # 1 t at -8 before 3 t at 0
        lines([0.0], [8.0, 8.0], mass_t=[1.0, 3.0]), [-8.0, 0.0], 1.0, [], {"speeds_mps": [6.0, 6.0]},
    ),
    "only the pressing part of a line is a block": (  # (-4 * 1 + 4 * 3) / 4
        lines([0.0, 0.0], [8.0] * 3, mass_t=[1.0, 1.0, 3.0]), [4.0, -4.0, 4.0], 1.0, [],
        {"speeds_mps": [12.0, 10.0, 10.0], "gaps_m": [1.0, 0.0]},
    ),
    "two pairs apart from each other meet at one instant": (
        lines([6.0, 99.0, 6.0], [0.0, 8.0, 0.0, 8.0]), 0.0, 0.75, [(0.75, 0, 8.0), (0.75, 2, 8.0)],
        {"speeds_mps": [4.0] * 4},
    ),
    "neighbouring pairs meet at one instant, in no order": (  # P = (4 + 8) / 4; v+ = 4.5 - 0.5 v
        lines([2.0, 6.0], [0.0, 2.0, 8.0], mass_t=[1.0, 2.0, 1.0], restitution=0.5), 0.0, 1.0,
        [(1.0, 0, 2.0), (1.0, 1, 6.0)], {"speeds_mps": [4.5, 3.5, 0.5]},
    ),
    "the rear of three is struck: the law takes all three": (  # P = 9 / 3: v+ = 4.5 - 0.5 v
        lines([0.0, 0.0], [0.0, 0.0, 9.0], restitution=0.5), 0.0, 0.0, [(0.0, 1, 9.0)], {"speeds_mps": [4.5, 4.5, 0.0]},
    ),
    "a pair that opens is left out": (  # P = 6, 6, 4
        lines([0.0, 0.0], [4.0, 8.0, 4.0], restitution=0.5), 0.0, 0.0, [(0.0, 0, 4.0)], {"speeds_mps": [7.0, 5.0, 4.0]},
    ),
    "a second round at the same instant counts again": (  # P = 22 / 4: 8.25, 4.25, 4.75; then 2 and 3 at 0.5
        lines([0.0, 0.0], [0.0, 8.0, 7.0], mass_t=[1.0, 1.0, 2.0], restitution=0.5), 0.0, 0.0,
        [(0.0, 0, 8.0), (0.0, 1, 0.5)], {"speeds_mps": [8.25, 4.75, 4.5]},
    ),
    "bounces without loss go on at a steady pace": (  # every flight lasts 2 * 8 / 4 s
        lines([0.0], [0.0, 8.0], mass_t=[2.0**60, 1.0], restitution=1.0), [-16.0, 4.0], 15.0,
        [(0.0, 0, 8.0), (4.0, 0, 8.0), (8.0, 0, 8.0), (12.0, 0, 8.0)], {"speeds_mps": [0.0, 4.0]},
    ),
    "an obstacle throws back": (  # 10 m at 20 m/s; v+ = -0.5 * 20; 5 m away again
        lines([50.0], [20.0, 0.0], mass_t=[3.0, 1.0], restitution=0.5, obstacle_gap_m=10.0),
        0.0, 1.0, [(0.5, -1, 20.0)],
        {"speeds_mps": [-10.0, 0.0], "gaps_m": [55.0], "obstacle_gap_m": 5.0, "obstacle_hit": True},
    ),
    "an obstacle is struck again": (  # thrown back at 5, its motor turns it round
        lines([99.0], [10.0, 0.0], restitution=0.5, obstacle_gap_m=0.0), [4.0, 0.0], 3.0,
        [(0.0, -1, 10.0), (2.5, -1, 5.0)], {"speeds_mps": [-0.5, 0.0]},
    ),
    "an obstacle takes 2 a g off the squared speed": (  # 400 - 12 * 28
        lines([99.0], [20.0, 0.0], restitution=0.0, obstacle_gap_m=28.0), [-6.0, 0.0], 8.0, [(2.0, -1, 8.0)],
        {"speeds_mps": [0.0, 0.0], "obstacle_gap_m": 0.0},
    ),
    "an obstacle out of the way of the brakes is not met": (  # 33.33 m
        lines([99.0], [20.0, 0.0], obstacle_gap_m=33.5), [-6.0, 0.0], 8.0, [], {"obstacle_hit": False},
    ),
    "an obstacle below the plastic speed ends the motion": (
        lines([99.0], [0.04, 0.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 1.0, [(0.0, -1, 0.04)],
        {"speeds_mps": [0.0, 0.0], "obstacle_hit": True},
    ),
    "an obstacle at the touch speed is not struck": (
        lines([99.0], [1e-5, 0.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 1.0, [],
        {"speeds_mps": [0.0, 0.0], "obstacle_hit": False},
    ),
    "an obstacle and who leans on it stay when struck": (  # P of (0, 10) bounded by 0 is (0, 0): v+ = -e v-
        lines([0.0], [0.0, 10.0], mass_t=[1.0, 100.0], restitution=0.5, obstacle_gap_m=0.0), 0.0, 0.0, [(0.0, 0, 10.0)],
        {"speeds_mps": [0.0, -5.0], "obstacle_hit": False},
    ),
    "an obstacle ends a plastic chain in one round": (
        lines([0.0, 0.0], [6.0, 8.0, 10.0], obstacle_gap_m=0.0), 0.0, 0.0,
        [(0.0, -1, 6.0), (0.0, 0, 2.0), (0.0, 1, 2.0)], {"speeds_mps": [0.0] * 3},
    ),
    **{
        f"an obstacle holds a line that presses with {command}": (
            lines([0.0, 0.0], [0.0] * 3, restitution=0.5, obstacle_gap_m=0.0), command, 5.0, [],
            {"speeds_mps": [0.0] * 3, "gaps_m": [0.0] * 2, "obstacle_gap_m": 0.0, "obstacle_hit": False},
        )
        for command in ([6.0, 6.0, 6.0], [-6.0, 6.0, 6.0], [0.0, -6.0, 6.0], [0.0, 0.0, 6.0])
    },
}  # fmt: skip


SHOWN = {
    "speeds_mps": lambda line: line[at.SPEED, 1:].tolist(),
    "gaps_m": lambda line: line[at.GAP, 1:-1].tolist(),
    "command_mps2": lambda line: line[at.FORCE, 1:].tolist(),
    "pair_hit": lambda line: (line[at.HIT, 1:-1] == 1.0).tolist(),
    "obstacle_gap_m": lambda line: line[at.GAP, 0],
    "obstacle_hit": lambda line: bool(line[at.HIT, 0]),
}


def run(line: Floats, car: Floats, command: Any, ends: list[float]) -> tuple[Floats, Events]:
    """Drive one line to each of these times; return it, with the first impact of each pair in every interval."""
    start, events = 0.0, list[tuple[float, int, float]]()
    for end in ends:
        line, met, scratch = driven(line, car, command, start, end)
        assert met[0] != FAILED
        if met[0] == EVENT_BY_EVENT:
            times, closing = scratch[0, at.NEXT_TIME], scratch[0, at.NEXT_CLOSING]
            ahead = 0 if line[0, at.GAP, 0] < at.FAR_M else 1
            pairs = [p for p in range(ahead, line.shape[2] - 1) if times[p] < math.inf]
            events += sorted((start + times[p], p - 1, closing[p]) for p in pairs)
        start = end
    return line[0], events


@pytest.mark.parametrize("name", CASES)
def test_interval__by_hand(name: str) -> None:
    (line, car), command, end, expected, shown = CASES[name]
    after, events = run(line, car, command, [*np.arange(0.25, end, 0.25).tolist(), end])
    assert {name: SHOWN[name](after) for name in shown} == shown
    pairs = range(after.shape[1] - 1)
    of_pair = {p: [(time, closing) for time, q, closing in expected if q == p - 1] for p in pairs}
    first = {p: hits[:1] for p, hits in of_pair.items() if hits}
    assert {p: [(t, w) for t, q, w in events if q == p - 1][:1] for p in first} == first
    assert after[at.IMPACTS, :-1].tolist() == [len(of_pair[p]) for p in pairs]
    assert after[at.TOTAL, :-1].tolist() == [sum(w * w for _, w in of_pair[p]) for p in pairs]
    assert after[at.FIRST, :-1].tolist() == [of_pair[p][0][1] ** 2 if of_pair[p] else 0.0 for p in pairs]


@pytest.mark.parametrize(("onset", "end"), [(0.4, 1.45), (0.12, 1.3)])
def test_end__that_an_event_reaches_is_the_end_itself(onset: float, end: float) -> None:
    # 1 m/s over `end` metres; the onset cuts the way in two, whose doubles add up to a little less or more than `end`
    assert onset + (end - onset) != end
    assert run(*lines([end], [0.0, 1.0], latency_s=[0.0, onset]), 0.0, [end])[1] == [(end, 0, 1.0)]


@pytest.mark.parametrize("limit", [5.6, 6.6])
def test_block__takes_the_limit_of_any_of_its_members_to_the_last_bit(limit: float) -> None:
    # 6 t coasting, pushed by 1 t at +1: a block at +1/7, until its rear vehicle is at its limit; the doubles of
    # speed + acceleration * time end a little beyond it
    assert 1.0 + 1.0 / 7.0 * ((limit - 1.0) / (1.0 / 7.0)) > limit
    line, car = lines([0.0], [1.0, 1.0], mass_t=[6.0, 1.0], speed_limit_mps=[64.0, limit])
    after, _ = run(line, car, [0.0, 1.0], [60.0])
    assert after[at.SPEED, 1:].tolist() == [limit, limit] and after[at.GAP, 1] == 0.0


@pytest.mark.parametrize(("gap", "sound"), [(-1.5e-9, True), (-2e-9, True), (-2.5e-9, False)])
def test_overlap__at_an_event_is_rounding_up_to_1e_9_m(gap: float, sound: bool) -> None:
    # vehicle 1 leaves vehicle 2 with 1e-9 m/s; vehicle 3 meets them after 1 s, when 1e-9 m of the overlap are gone
    after, met, _ = driven(*lines([gap, 8.0], [1e-9, 0.0, 8.0]), 0.0, 0.0, 1.0)
    assert (met[0] == EVENT_BY_EVENT) == sound and (met[0] == FAILED) != sound
    assert not sound or (after[0, at.IMPACTS, 1:3].tolist() == [0.0, 1.0] and (after[0, at.GAP, 1:3] == 0.0).all())


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
    after, _ = run(*lines([0.0], [0.0, closing], restitution=0.5), 0.0, [0.0])
    assert (after[at.IMPACTS, 1], after[at.TOTAL, 1], after[at.HIT, 1]) == (count, count * closing**2, count)
    front, rear = after[at.SPEED, 1:]
    assert front - rear == pytest.approx(apart, rel=1e-15) and front + rear == pytest.approx(closing, rel=1e-15)


@pytest.mark.parametrize("e", [0.125, 0.875])
def test_bounces__end_after_the_sum_of_their_flights(e: float) -> None:
    # rear presses with 4 on a holding wall: bounces 8, 8e, 8e^2, ... down to the first below 0.05, which is plastic
    closing = [8.0]
    while closing[-1] >= 0.05:
        closing.append(closing[-1] * e)
    line, car = lines([0.0], [0.0, 8.0], mass_t=[2.0**50, 1.0], restitution=e)
    after, _ = run(line, car, [-16.0, 4.0], [60.0])
    assert after[at.IMPACTS, 1] == len(closing)
    assert after[at.TOTAL, 1] == pytest.approx(sum(w * w for w in closing), rel=1e-10)
    assert after[at.GAP, 1] == 0.0 and after[at.SPEED, 2] == pytest.approx(0.0, abs=1e-12)
    flights = sum(2.0 * w / 4.0 for w in closing[1:])  # just before their end it still flies
    assert run(line, car, [-16.0, 4.0], [flights - 1e-3])[0][at.IMPACTS, 1] == len(closing) - 1


@pytest.mark.parametrize(
    ("gap_m", "mass", "speeds", "commands", "harm"),
    [
        (1.0, [9.4, 1.25, 5.6], [0.0, 11.6, 11.6], [0.0, -2.0, -5.0], 466.130127),
        (1e-3, [9.4, 1.25, 5.6], [0.0, 11.6, 11.6], [0.0, -2.0, -5.0], 499.372470),
        (1e-9, [1.0, 1.0, 1.0], [0.0, 8.0, 8.0], [0.0, -0.001, -0.002], 64.0 * 4.0 / 3.0),  # 1 + 1/4 + 1/16 + ...
    ],
)
def test_rattling__without_restitution_plays_every_impact(
    gap_m: float, mass: list[float], speeds: list[float], commands: list[float], harm: float
) -> None:
    """An infinite series: each gap is about the square of the one before, so it ends within one moment."""
    line, _, _ = driven(*lines([gap_m, 0.0], speeds, mass_t=mass), commands, 0.0, 8.0)
    assert line[0, at.TOTAL].sum() == pytest.approx(harm, rel=1e-8)


def test_rattling__between_two_heavy_ones_conserves_momentum() -> None:
    # e = 0: the gaps shrink below the smallest double
    mass, commands = [31.0, 0.65, 12.5], [-1.44, -6.02, -8.25]
    line, car = lines([1.0, 1.0], [9.05, 9.29, 15.95], mass_t=mass)
    momentum = np.array(mass) @ line[0, at.SPEED, 1:]
    for start in np.arange(0.0, 1.0, 0.01):
        line, _, _ = driven(line, car, commands, start, start + 0.01)
        momentum += 0.01 * np.array(mass) @ np.array(commands)
        assert np.array(mass) @ line[0, at.SPEED, 1:] == pytest.approx(momentum, rel=1e-12)
    assert line[0, at.IMPACTS, 1:3].sum() == 363.0


def test_changes_of_speed__are_the_largest_of_one_impact_at_each_side() -> None:
    # 8 m/s into 2 t at rest with 1 t: both at 8/3; then the pair, 3 t, is struck by 3 t at 8 m/s: all at 16/3
    line, car = lines([0.0, 6.0], [0.0, 8.0, 8.0], mass_t=[2.0, 1.0, 3.0])
    _, _, scratch = driven(line, car, 0.0, 0.0, 4.0)
    assert scratch[0, at.FRONT_CHANGE, 1:] == pytest.approx([0.0, 16.0 / 3.0, 8.0 / 3.0])
    assert scratch[0, at.REAR_CHANGE, 1:] == pytest.approx([8.0 / 3.0, 8.0 / 3.0, 0.0])


@pytest.mark.parametrize(
    ("speed", "rate", "way"), [(20.0, 12.65, 34.01572), (20.0, np.inf, 28.57143), (1.0, 12.65, 0.26508)]
)
def test_vehicle__stops_after_its_way_with_brakes_that_build_up(speed: float, rate: float, way: float) -> None:
    # v b / (2 r) - b^3 / (24 r^2) + v^2 / (2 b) with b = 7; from 1 m/s it stops before its brakes have full force
    after, _ = run(*lines([100.0], [0.0, speed], brake_rate_mps3=rate), [0.0, -7.0], [10.0])
    assert 100.0 - after[at.GAP, 1] == pytest.approx(way, abs=1e-5) and after[at.SPEED, 2] == 0.0
    of_formula = stopping_distances(*(np.array([x]) for x in (speed, 0.5, 7.0, rate)))
    assert of_formula == pytest.approx(way + 0.5 * speed, abs=1e-5)


def test_command__that_ends_at_the_latency_never_acts() -> None:
    # driven at +6 until 0.8, braked at 6 from then on, with a latency of 0.8: the brakes build up from a force of 0
    line, car = lines([50.0], [0.0, 20.0], latency_s=0.8, brake_rate_mps3=12.65)
    line, _, _ = driven(line, car, [0.0, 6.0], 0.0, 0.8)
    after, _, _ = driven(line, car, [0.0, -6.0], 0.8, 1.2)
    assert line[0, at.SPEED, 2] == 20.0 and after[0, at.SPEED, 2] == pytest.approx(20.0 - 12.65 * 0.4**2 / 2.0)


def test_vehicles__that_brake_alike_keep_their_gap() -> None:
    settings = {"latency_s": 0.3, "brake_rate_mps3": 12.65, "release_rate_mps3": 25.3}
    line, car = lines([0.0, 3.0], [20.0] * 3, **settings)
    for start, command in ((0.0, -7.0), (0.4, 2.0), (1.7, -9.0)):
        line, _, _ = driven(line, car, command, start, start + 1.3)
    assert line[0, at.GAP, 1:3].tolist() == [0.0, 3.0] and not line[0, at.IMPACTS].any()
