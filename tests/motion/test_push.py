"""The push of a contact that lasts: numbers by hand. Masses are 1 t unless a case says otherwise."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from tests.motion.lines import driven, lines

# The line, its command, the end, and the push of every pair (m/s), of the obstacle and Vehicle 1 first.
CASES: dict[str, tuple[Any, Any, float, list[float]]] = {
    "a coasting rear leans on a braking front": (  # -8 and 0: 8 m/s2 for 1 s, whatever the masses
        lines([0.0], [10.0, 10.0], mass_t=[1.0, 3.0]), [-8.0, 0.0], 1.0, [0.0, 8.0],
    ),
    "somebody who drives far behind pushes nobody": (
        lines([0.0, 90.0], [10.0] * 3), [-8.0, 0.0, 3.0], 1.0, [0.0, 8.0, 0.0],
    ),
    "a rear drives against a braking front": (  # 3 + 6 = 9 m/s2 for 2 s
        lines([0.0], [20.0, 20.0]), [-6.0, 3.0], 2.0, [0.0, 18.0],
    ),
    "a rear at its speed limit drives, as soon as it is below": (  # the same: the block slows down at 1.5 m/s2
        lines([0.0], [20.0, 20.0], speed_limit_mps=20.0), [-6.0, 3.0], 2.0, [0.0, 18.0],
    ),
    "a rear keeps its speed limit against a braking front": (  # with 1 m/s2 of its 3; alone it would need 0: 0 + 1
        lines([0.0], [20.0, 20.0], speed_limit_mps=20.0), [-1.0, 3.0], 2.0, [0.0, 2.0],
    ),
    "three in a row, 1, 2 and 3 t": (
        # -6, 0 and 2: the line has 0. Behind pair 1: (2 x 0 + 3 x 2) / 5 = 1.2, so 7.2; in front of pair 2:
        # (1 x -6 + 2 x 0) / 3 = -2, so 4; for 1.5 s
        lines([0.0, 0.0], [9.0] * 3, mass_t=[1.0, 2.0, 3.0]), [-6.0, 0.0, 2.0], 1.5, [0.0, 10.8, 6.0],
    ),
    "three in a row whose rear part would not stay together": (
        # -6, 3 and 0: alone Vehicle 2 leaves Vehicle 3 with 3, so 9; in front of pair 2 there is (-6 + 3) / 2
        lines([0.0, 0.0], [9.0] * 3), [-6.0, 3.0, 0.0], 1.0, [0.0, 9.0, 1.5],
    ),
    "brakes of the front build up": (  # -4 t until 2 s: 4 x 2^2 / 2, then -8 for 0.5 s
        lines([0.0], [20.0, 20.0], brake_rate_mps3=[4.0, np.inf]), [-8.0, 0.0], 2.5, [0.0, 12.0],
    ),
    "a rear drives ever harder against one that its brakes hold": (
        # at rest, brakes of 4: they hold 2 t against 3 m/s2 of 1 t. 2 t until 1.5 s: 1.5^2, then 3 for 0.5 s
        lines([0.0], [0.0, 0.0], force_mps2=[-4.0, 0.0], release_rate_mps3=[np.inf, 2.0]), [-4.0, 3.0], 2.0,
        [0.0, 3.75],
    ),
    "brakes of the one between take over": (
        # at rest; Vehicle 3 drives at 2, Vehicle 2's brakes build up at 1 m/s3: on Vehicle 1 presses (2 - t) / 2 until
        # 2 s, 1 m/s, then nothing; on Vehicle 2, which others hold, 2 for 3 s
        lines([0.0, 0.0], [0.0] * 3, force_mps2=[-4.0, 0.0, 2.0], brake_rate_mps3=[np.inf, 1.0, np.inf]),
        [-4.0, -3.5, 2.0], 3.0, [0.0, 1.0, 6.0],
    ),
    "a push moves one that its brakes hold": (
        # at rest; -4 and 2 t: on the front, which is held, presses 2 t until 2 s; then both move, and the front alone
        # would slow down at 4: 2 t + 4 for 1 s
        lines([0.0], [0.0, 0.0], force_mps2=[-4.0, 0.0], release_rate_mps3=[np.inf, 2.0]), [-4.0, 16.0], 3.0,
        [0.0, 4.0 + 9.0],
    ),
    "a part of the rear hangs on": (
        # -6; 3 - 2 t; 1. Vehicle 2 alone, 3 - 2 t, until 1 s; then with Vehicle 3 (4 - 2 t) / 2: 2 + 0.375 until 1.5 s,
        # and 6 x 1.5. In front of pair 2: (-3 - 2 t) / 2 = -2.25 - 1.125 in all, and 1 x 1.5
        lines([0.0, 0.0], [20.0] * 3, force_mps2=[-6.0, 3.0, 1.0], brake_rate_mps3=[np.inf, 2.0, np.inf]),
        [-6.0, -2.0, 1.0], 1.5, [0.0, 11.375, 4.875],
    ),
    "against an obstacle": (  # 3 against it; 2 against Vehicle 1, which it stops; for 2 s
        lines([0.0], [0.0, 0.0], obstacle_gap_m=0.0), [3.0, 2.0], 2.0, [6.0, 4.0],
    ),
    "against an obstacle with somebody heavier behind": (  # Vehicle 2 presses with 4, both with (3 + 3 x 4) / 4
        lines([0.0], [0.0, 0.0], obstacle_gap_m=0.0, mass_t=[1.0, 3.0]), [3.0, 4.0], 2.0, [7.5, 8.0],
    ),
    "against an obstacle with somebody parked behind": (  # who does not hold it back
        lines([0.0], [0.0, 0.0], obstacle_gap_m=0.0), [3.0, -6.0], 2.0, [6.0, 0.0],
    ),
    "an impact is no push": (  # after 0.75 s both have 4 m/s; then the front brakes at 2 for 1 s
        lines([6.0], [0.0, 8.0], latency_s=[0.75, 0.0]), [-2.0, 0.0], 1.75, [0.0, 2.0],
    ),
    "a bounce is no push": (lines([6.0], [0.0, 8.0], restitution=0.5), 0.0, 2.0, [0.0, 0.0]),
    "further impacts push: a bouncing rear comes back": (
        # 8 against 4 at once, e = 0.5: they part with 2. The front brakes at 4: after 1 s they meet again with 2, all
        # built up, and part with 1: 3. Then 1 and 0.5: 1.5, ... In all 6 until 2 s, as small impacts as one likes; then
        # the contact lasts: 4 for 0.5 s. The last impacts, below 0.05 m/s, do not bounce.
        lines([0.0], [4.0, 8.0], mass_t=1.0, restitution=0.5), [-4.0, 0.0], 2.5, [0.0, 8.0],
    ),
    "being struck from behind and thrown forward is no push": (
        # Vehicle 2 strikes Vehicle 1 and bounces (e = 0.5), Vehicle 3 strikes it later; all coast
        lines([0.0, 9.0], [4.0, 8.0, 16.0], restitution=0.5), 0.0, 6.0, [0.0, 0.0, 0.0],
    ),
    "of an impact only what forces have built up": (
        # 4 and 8 become 7 and 5; Vehicle 1 brakes at 3 to 4 m/s until Vehicle 3 comes at 1 s: -2 + 3 = 1 is built up.
        # Vehicle 2 then has 11.75. 0.5 = 7.75 t + 1.5 t^2 until it meets Vehicle 1; 1 + 3 t of 7.75 + 3 t is built up
        lines([0.0, 9.0], [4.0, 8.0, 14.0], restitution=0.5), [-3.0, 0.0, 0.0], 1.2,
        [0.0, 1.5 * (63.0625**0.5 - 6.75), 0.0],
    ),
    "a touch is no push: all brake alike": (lines([0.0, 0.0], [9.0] * 3, mass_t=[1.1, 0.7, 3.3]), -0.7, 5.0, [0.0] * 3),
    "a touch is no push: the front drives away": (lines([0.0], [4.0, 4.0]), [2.0, 1.0], 2.0, [0.0, 0.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_push__by_hand(name: str) -> None:
    (line, car), command, until, pushes = CASES[name]
    after, _, _ = driven(line, car, command, 0.0, until)
    assert after[0, at.PUSHED, :-1].tolist() == pytest.approx(pushes, abs=1e-7)  # a parting is delayed by 1e-9 s
    assert [each == 0.0 for each in after[0, at.PUSHED, :-1]] == [each == 0.0 for each in pushes]
    assert after[0, at.PUSHED, -1] == 0.0


# The line, its command, the end, the push of every pair, and the push for which every vehicle answers (m/s).
ANSWERS: dict[str, tuple[Any, Any, float, list[float], list[float]]] = {
    "one between, that brakes fully, is pushed through": (  # 5 - -6 behind; (-6 + 5) / 2 - -6 in front
        lines([0.0, 0.0], [20.0] * 3, braking_capacity_mps2=6.0), [-6.0, -6.0, 5.0], 1.0,
        [0.0, 5.5, 11.0], [0.0, 0.0, 16.5],
    ),
    "the same from rest": (  # 14 - -6 behind; (-6 + 14) / 2 - -6 in front; for 2 s
        lines([0.0, 0.0], [0.0] * 3, braking_capacity_mps2=6.0), [-6.0, -6.0, 14.0], 2.0,
        [0.0, 20.0, 40.0], [0.0, 0.0, 60.0],
    ),
    "the one between answers for what it adds": (  # pair 1, 1.2 - -6: 6 of Vehicle 2, 1.2 of Vehicle 3; for 1.5 s
        lines([0.0, 0.0], [9.0] * 3, mass_t=[1.0, 2.0, 3.0]), [-6.0, 0.0, 2.0], 1.5,
        [0.0, 10.8, 6.0], [0.0, 9.0, 1.8 + 6.0],
    ),
    "two press on one that does not": (
        # pair 1: (-6 + 0 + 2 x 2) / 4 - -6, in proportion to 1 x 6 and 2 x 8; pair 2: 6 of Vehicle 3 and 4 / 3
        lines([0.0] * 3, [20.0] * 4, mass_t=[1.0, 1.0, 1.0, 2.0]), [-6.0, -6.0, 0.0, 2.0], 1.0,
        [0.0, 5.5, 6.0 + 4.0 / 3.0, 6.0], [0.0, 0.0, 1.5 + 6.0, 4.0 + 4.0 / 3.0 + 6.0],
    ),
    "the last one presses, but on one that brakes hard": (
        # pair 1: the mean is largest up to Vehicle 3, (-4 + 0) / 2 - -6: 2 of Vehicle 2, 2 of Vehicle 3
        lines([0.0] * 4, [20.0] * 5), [-6.0, -4.0, 0.0, -10.0, 5.0], 1.0,
        [0.0, 4.0, 5.0, -2.5 + 10.0 / 3.0, 15.0], [0.0, 2.0, 2.0 + 5.0, 0.0, -2.5 + 10.0 / 3.0 + 15.0],
    ),
    "both brake fully": (  # 1 m/s2 until they rest; nobody answers
        lines([0.0], [20.0, 20.0], braking_capacity_mps2=[7.0, 6.0]), [-7.0, -6.0], 5.0, [0.0, 20.0 / 6.5], [0.0, 0.0],
    ),
    "one presses through another, and brakes fully": (
        lines([0.0, 0.0], [20.0] * 3, braking_capacity_mps2=[16.0, 16.0, 4.0]), [-8.0, -8.0, -4.0], 1.0,
        [0.0, 2.0, 4.0], [0.0, 0.0, 0.0],
    ),
    "one of two that press brakes fully": (  # pair 1, -5 - -8: in proportion to 2 (Vehicle 3) and 4 (Vehicle 4)
        lines([0.0] * 3, [20.0] * 4, braking_capacity_mps2=[16.0, 16.0, 6.0, 16.0]), [-8.0, -8.0, -6.0, -4.0], 1.0,
        [0.0, 2.0, 3.0, 10.0 / 3.0], [0.0, 0.0, 0.0, 4.0 / 3.0 + 1.0 + 10.0 / 3.0],
    ),
    "brakes of one between build up": (  # -6; 3 - 2 t; 1. Vehicle 2: 9 - 2 t; the rest of 11.375 is of Vehicle 3
        lines([0.0, 0.0], [20.0] * 3, force_mps2=[-6.0, 3.0, 1.0], brake_rate_mps3=[np.inf, 2.0, np.inf]),
        [-6.0, -2.0, 1.0], 1.5, [0.0, 11.375, 4.875], [0.0, 11.25, 5.0],
    ),
    "brakes build up to their capacity": (  # -6 and -2 t until 2 s: 6 - 2 t; then -4 and nobody's: 2 for 1 s
        lines([0.0], [20.0, 20.0], braking_capacity_mps2=[16.0, 4.0], brake_rate_mps3=[np.inf, 2.0]), [-6.0, -4.0], 3.0,
        [0.0, 8.0 + 2.0], [0.0, 8.0],
    ),
    "an engine lets go while full braking is commanded": (  # -6; 3 - 12 t until 0.75 s: 9 - 12 t
        lines([0.0], [20.0, 20.0], braking_capacity_mps2=6.0, force_mps2=[-6.0, 3.0], brake_rate_mps3=12.0), -6.0, 2.0,
        [0.0, 3.375], [0.0, 3.375],
    ),
    "brakes let go": (  # -6; -6 + 6 t for 1 s
        lines([0.0], [20.0, 20.0], braking_capacity_mps2=6.0, force_mps2=-6.0, release_rate_mps3=6.0), [-6.0, 0.0], 1.0,
        [0.0, 3.0], [0.0, 3.0],
    ),
    "forces that cancel are no brakes that hold": (  # 5 - -2.5 behind; (-2.5 + 5) / 2 - -2.5 in front
        lines([0.0, 0.0], [20.0] * 3, braking_capacity_mps2=2.5), [-2.5, -2.5, 5.0], 1.0,
        [0.0, 3.75, 7.5], [0.0, 0.0, 11.25],
    ),
    "brakes hold the same forces at rest": (  # 5 on Vehicle 2; (-2.5 + 5) / 2 of it on Vehicle 1
        lines([0.0, 0.0], [0.0] * 3, braking_capacity_mps2=2.5), [-2.5, -2.5, 5.0], 1.0,
        [0.0, 1.25, 5.0], [0.0, 0.0, 6.25],
    ),
    "a speed limit holds nobody at rest": (  # 0 - -6 in front of Vehicle 2, 1 of it its own; 0 - -5.5 behind it
        lines([0.0, 0.0], [20.0] * 3, mass_t=[5.0, 5.0, 20.0], speed_limit_mps=20.0, braking_capacity_mps2=6.0),
        [-6.0, -5.0, 7.0], 1.0, [0.0, 6.0, 5.5], [0.0, 1.0, 5.0 + 5.5],
    ),
    "a speed limit of two that drive": (  # each keeps its limit: 0 - -6, and 0 - (-6 + 1) / 2
        lines([0.0, 0.0], [20.0] * 3, mass_t=[5.0, 5.0, 20.0], speed_limit_mps=20.0), [-6.0, 1.0, 7.0], 1.0,
        [0.0, 6.0, 2.5], [0.0, 6.0, 2.5],
    ),
    "backward, brakes press forward": (  # the front coasts backward and answers: 4 for 1 s
        lines([0.0], [-10.0, -10.0], braking_capacity_mps2=4.0), [0.0, -4.0], 1.0, [0.0, 4.0], [4.0, 0.0],
    ),
    "full braking that is not yet in effect": (
        lines([0.0], [20.0, 20.0], braking_capacity_mps2=[16.0, 4.0], latency_s=[0.0, 1.0]), [-6.0, -4.0], 2.0,
        [0.0, 6.0 + 2.0], [0.0, 6.0],
    ),
    "brakes of the one between take over at rest": (
        lines([0.0, 0.0], [0.0] * 3, force_mps2=[-4.0, 0.0, 2.0], brake_rate_mps3=[np.inf, 1.0, np.inf]),
        [-4.0, -3.5, 2.0], 3.0, [0.0, 1.0, 6.0], [0.0, 0.0, 7.0],
    ),
    "against an obstacle": (  # 3 x 2 of Vehicle 1, the rest of 7.5 of Vehicle 2
        lines([0.0], [0.0, 0.0], obstacle_gap_m=0.0, mass_t=[1.0, 3.0]), [3.0, 4.0], 2.0, [7.5, 8.0], [6.0, 9.5],
    ),
    "further impacts": (
        lines([0.0], [24.0, 28.0], restitution=0.5), [-6.0, -2.0], 2.5, [0.0, 8.0], [0.0, 8.0],
    ),
    "further impacts under full braking": (
        lines([0.0], [24.0, 28.0], restitution=0.5, braking_capacity_mps2=[16.0, 2.0]), [-6.0, -2.0], 2.5,
        [0.0, 8.0], [0.0, 0.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ANSWERS)
def test_answers__by_hand(name: str) -> None:
    (line, car), command, until, pushes, answers = ANSWERS[name]
    after, _, _ = driven(line, car, command, 0.0, until)
    assert after[0, at.PUSHED, :-1].tolist() == pytest.approx(pushes, abs=1e-7)
    assert after[0, at.ANSWERED, :-1].tolist() == pytest.approx(answers, abs=1e-7)
    assert after[0, at.ANSWERED, -1] == after[0, at.SHARED, -1] == 0.0
    assert after[0, [at.ANSWERED, at.SHARED]].sum() == pytest.approx(sum(pushes), abs=1e-7)


def test_push_that_nobody_answers_for__is_shared_by_those_in_contact() -> None:
    # Vehicle 3 presses on Vehicle 2 with 1 m/s2 for 1 s. Vehicle 1 is far ahead, Vehicle 4 follows 1 m behind.
    line, car = lines([30.0, 0.0, 1.0], [20.0] * 4, braking_capacity_mps2=[7.0, 7.0, 6.0, 6.0])
    after, _, _ = driven(line, car, [-7.0, -7.0, -6.0, -6.0], 0.0, 1.0)
    assert after[0, at.PUSHED].tolist() == pytest.approx([0.0, 0.0, 1.0, 0.0, 0.0])
    assert after[0, at.SHARED].tolist() == pytest.approx([0.0, 0.5, 0.5, 0.0, 0.0])
    line, car = lines([0.0], [0.0, 0.0], obstacle_gap_m=0.0, braking_capacity_mps2=0.0)  # the obstacle has no part
    after, _, _ = driven(line, car, [0.0, 0.0], 0.0, 1.0)
    assert not after[0, at.SHARED].any()


# Settings, commands with the time until which vehicles hold them, and the answers and shares (m/s). At 20 m/s, 1 m
# apart, brakes 6, e = 0.5. Vehicle 1 brakes fully. If Vehicle 2 coasts until 1.1 s, they meet at 0.57735 s with 3.4641
# m/s and again with -1.73205 + 6 x 0.52265 = 1.40385: a push of 2.10577.
FULL, LATER = -6.0, 2.10577
LATER_IMPACTS: dict[str, tuple[dict[str, Any], list[tuple[list[float], float]], list[float], list[float]]] = {
    "who has coasted answers, although it brakes fully at the impact": (
        {}, [([FULL, 0.0], 1.1), ([FULL, FULL], 3.0)], [0.0, LATER], [0.0, 0.0],
    ),
    "speed kept in the latency is nobody's, whatever the command": (
        {"latency_s": [0.0, 1.1]}, [([FULL, 3.0], 1.1), ([FULL, FULL], 3.0)], [0.0, 0.0], [LATER / 2.0, LATER / 2.0],
    ),
    "impacts within the latency are the rear's": (  # again with 1.73205 after 0.57735 s
        {"latency_s": [0.0, 1.3]}, [([FULL, FULL], 1.2)], [0.0, 1.5 * 1.73205], [0.0, 0.0],
    ),
    "who has coasted before the first impact alone does not answer for weaker brakes": (
        # 2.1 m/s and 0.685 m at 0.3 s, then 1 m/s2: the first impact with 2.40416, the second with half of it
        {"braking_capacity_mps2": [7.0, 6.0]}, [([-7.0, 0.0], 0.3), ([-7.0, FULL], 3.05)],
        [0.0, 0.0], [0.90156, 0.90156],
    ),
    "one presses the one between towards the front, and brakes fully at the impact": (
        # -6; (-6 + 3) / 2: with 3 m/s at 2/3 s, 1.5 apart; 0.45 at 1.1 s, push 0.675. Vehicle 3 on Vehicle 2: 9 x 1.1
        {}, [([FULL, FULL, 3.0], 1.1), ([FULL] * 3, 2.0)], [0.0, 0.0, 9.9 + 0.675], [0.0, 0.0, 0.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LATER_IMPACTS)
def test_answers_for_later_impacts__by_hand(name: str) -> None:
    settings, commands, answers, shares = LATER_IMPACTS[name]
    N, start = len(answers), 0.0
    settings = {"braking_capacity_mps2": 6.0, **settings}
    line, car = lines([1.0, 0.0][: N - 1], [20.0] * N, restitution=0.5, **settings)
    for command, until in commands:
        line, _, _ = driven(line, car, command, start, until)
        start = until
    assert line[0, at.ANSWERED, :-1].tolist() == pytest.approx(answers, abs=1e-4)
    assert line[0, at.SHARED, :-1].tolist() == pytest.approx(shares, abs=1e-4)


# The line, its commands, the end, and the speed (m/s) that every vehicle has from contacts.
FOREIGN: dict[str, tuple[Any, Any, float, list[float]]] = {
    "struck from behind": (lines([2.0], [4.0, 8.0]), 0.0, 1.0, [2.0, 0.0]),  # after 0.5 s both have 6
    "struck and pushed on, although its brakes would have stopped it": (  # 6 - 1.5 x 1.5
        lines([2.0], [4.0, 8.0], latency_s=[0.5, 9.0]), [-3.0, 0.0], 2.0, [3.75, 0.0],
    ),
    "pushed": (lines([0.0], [10.0, 10.0]), [-6.0, 0.0], 1.0, [3.0, 0.0]),  # 7 instead of 4
    "pushed beyond standstill": (lines([0.0], [3.0, 3.0]), [-6.0, 8.0], 1.0, [4.0, 0.0]),
    "slowed by the one ahead, then pushed": (  # Vehicle 2 has 5 of 10; 3 m/s2 of 1 t: after 1.5 s 5 + 1.5 in common
        lines([0.0, 1.0], [0.0, 10.0, 5.0], latency_s=[9.0, 9.0, 0.0]), [0.0, 0.0, 3.0], 1.5, [6.5, 1.5, 0.0],
    ),
    "thrown back": (lines([9.0], [20.0, 0.0], obstacle_gap_m=5.0, restitution=0.1), 0.0, 1.0, [0.0, 0.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", FOREIGN)
def test_speed_from_contacts__by_hand(name: str) -> None:
    (line, car), command, until, foreign = FOREIGN[name]
    after, _, _ = driven(line, car, command, 0.0, until)
    assert after[0, at.FOREIGN, 1:].tolist() == pytest.approx(foreign, abs=1e-7)


def test_push__adds_up_from_interval_to_interval() -> None:
    line, car = lines([0.0], [10.0, 10.0])
    half, _, _ = driven(line, car, [-8.0, 0.0], 0.0, 0.5)
    whole, _, _ = driven(half, car, [-4.0, 0.0], 0.5, 1.0)
    assert (half[0, at.PUSHED, 1], whole[0, at.PUSHED, 1]) == (4.0, 6.0)


# The line, its restitution, and what contacts pass on (m2/s2), of the obstacle and Vehicle 1 first. All coast.
PASSED: dict[str, tuple[Any, list[float]]] = {
    "two that touch strike an obstacle": (  # Vehicle 1 alone bounces with 1 m/s: 11 between it and Vehicle 2
        lambda gap: lines([gap], [10.0, 10.0], obstacle_gap_m=5.0, restitution=0.1), [0.0, 121.0],
    ),
    "three that touch strike an obstacle": (  # the first two alone bounce with 1 m/s: 11 between each
        lambda gap: lines([gap, 0.0], [10.0] * 3, obstacle_gap_m=5.0, restitution=0.1), [0.0, 121.0, 121.0],
    ),
    "one of two that touch is struck": (  # Vehicles 2 and 3 alone: 6 in common, Vehicle 2 has 7; 3 to Vehicle 1
        lambda gap: lines([gap, 5.0], [4.0, 4.0, 8.0], restitution=0.5), [0.0, 9.0, 0.0],
    ),
    "the one between is struck from both sides": (  # each contact takes up its own closing speed, and the other's
        # change of Vehicle 2: in front 8 - 4 and after the impact behind (8 + 12) / 2 + 2 = 12; behind 12 - 4
        lambda gap: lines([5.0, 5.0], [4.0, 8.0, 12.0], restitution=1.0), [0.0, 8.0**2 - 4.0**2, 8.0**2 - 4.0**2],
    ),
    "two strike each other": (lambda gap: lines([5.0], [4.0, 8.0], restitution=0.5), [0.0, 0.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", PASSED)
def test_passed_on__by_hand(name: str) -> None:
    make, harm = PASSED[name]
    after, _, _ = driven(*make(0.0), 0.0, 0.0, 1.4)
    assert after[0, at.PASSED, :-1].tolist() == pytest.approx(harm, abs=1e-9)
    assert [each == 0.0 for each in after[0, at.PASSED, :-1]] == [each == 0.0 for each in harm]


@pytest.mark.parametrize("name", ["two that touch strike an obstacle", "one of two that touch is struck"])
def test_passed_on__is_what_the_pair_bears_a_little_apart(name: str) -> None:
    make, harm = PASSED[name]
    touching, _, _ = driven(*make(0.0), 0.0, 0.0, 1.4)
    apart, _, _ = driven(*make(1e-7), 0.0, 0.0, 1.4)
    assert touching[0, at.FIRST, 1] == 0.0 and apart[0, at.PASSED].max() < 1e-3
    assert apart[0, at.FIRST, 1] == pytest.approx(harm[1], rel=1e-5)
