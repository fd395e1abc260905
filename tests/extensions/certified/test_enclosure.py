"""Interior mode: the bound holds for every world of the box, by hand and against worlds drawn from it."""

from typing import NamedTuple

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import drive, script_agents
from ethbrake_marl.agents.protocol import fixed_commands
from ethbrake_marl.engine.profiles import profile_problem
from ethbrake_marl.extensions.certified import affine, enclosure
from ethbrake_marl.extensions.certified.affine import (
    CLOSING,
    HARDEST,
    OPENING,
    SOFTEST,
    TOUCH_WIDTH,
    TOUCHES,
    WIDE,
    Path,
    high,
    hold,
    move_alone,
    new_motion,
)
from ethbrake_marl.extensions.certified.enclosure import Known, cell_of, wait
from ethbrake_marl.extensions.certified.paths import go_on, may_meet_unseen, meet, new_stack
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.touching import backwards, bounce, stray
from ethbrake_marl.extensions.certified.uncertainty import Uncertainty, parse_uncertainty
from ethbrake_marl.shields.certify import plan_harm
from ethbrake_marl.shields.drivers import ShieldedDriver
from ethbrake_marl.shields.running import begin_running
from tests.extensions.certified.test_uncertainty import STANDING

STEPS = 81
PAPER = eb.load_scenario("paper-random")
EARLY = PAPER.replace(early_impacts="keep")

UNUSUAL = {
    "gaps": ({}, "gaps_m=1"),
    "capacities": ({"restitution": 0.0}, "braking_capacity_mps2=5%"),
    "very unequal masses": ({"mass_t": [0.05, 100, 1], "restitution": 0.3}, "mass_t=20%,gaps_m.pair_2=0.5"),
    "late leader": ({"latency_s": [0.6, 0.2, 0.9]}, "latency_s.vehicle_1=0.15,speeds_mps.vehicle_2=0.5"),
    "own latency": ({}, "latency_s.vehicle_2=0.1,gaps_m.pair_1=0.5"),
    "elastic": ({"restitution": 1.0}, "speeds_mps=0.4"),
    "close": ({"gaps_m": [0.3, 0.2]}, "gaps_m=0.2,latency_s.vehicle_3=0.1"),
    "driving": ({"driving_capacity_mps2": 8, "speed_limit_mps": 22.5}, "driving_capacity_mps2=20%"),
    "build up": ({"brake_rate_mps3": 12.65, "release_rate_mps3": 40}, "brake_rate_mps3=20%,latency_s.vehicle_2=0.1"),
    "slow build up": (
        {"brake_rate_mps3": [3, 2, 9], "speeds_mps": [4, 3.5, 4], "gaps_m": 1, "restitution": 1.0},
        "brake_rate_mps3=20%,gaps_m=0.2",
    ),
}


class Case(NamedTuple):
    """A box around worlds."""

    scenario: eb.Scenario
    worlds: eb.Worlds
    uncertainty: Uncertainty
    boxes: enclosure.Boxes


def boxed(text, scenario=EARLY, *, seed=3, first=0, **changes):
    """One world of the scenario, and its box."""
    scenario = scenario.replace(**changes) if changes else scenario
    worlds, uncertainty = scenario.sample(1, seed, first=first).worlds, parse_uncertainty(text)
    possible, others = uncertainty.members(worlds), script_agents(scenario, except_for=1)
    command = fixed_commands(others, possible, "test", vehicle=1)
    problem = profile_problem(possible, [1], horizon_s=scenario.horizon_s, others_mps2=command)
    return Case(scenario, worlds, uncertainty, enclosure.Boxes.of(possible, problem, 1, scenario, others))


def cell_in(case, low, plan, vehicle=1):
    """The cell of the part of the box above ``low``, and by how much its first decision may be late."""
    boxes = case.boxes
    known = Known(
        vehicle, boxes.constant[0], boxes.limit[0], float(boxes.restitution[0]), float(boxes.begin_s[0]),
        boxes.time_step_s, boxes.horizon_s,
    )  # fmt: skip
    return cell_of(low, boxes.high[0], np.flatnonzero(boxes.high[0] > boxes.low[0]), known, plan)


def bound_of(case, plan, cells):
    return case.boxes.bound(np.arange(1), plan[np.newaxis], np.zeros(1), cells)[0]


def harm_inside(scenario, worlds, uncertainty, plan, draws, seed=1):
    """Harm of the plan in worlds drawn from the box."""
    truth = uncertainty.draw(worlds.take(np.zeros(draws, np.int64)), np.random.default_rng(seed))
    command = fixed_commands(script_agents(scenario, except_for=1), truth, "test", vehicle=1)
    running = begin_running(profile_problem(truth, [1], horizon_s=scenario.horizon_s, others_mps2=command))
    return plan_harm(running, np.repeat(plan[np.newaxis], draws, axis=0))


def plans(rng, braking=-0.9):
    """Braking, and something that changes every 0.4 s."""
    return np.full(STEPS, braking), np.repeat(rng.uniform(-1.0, 0.6, 30), 4)[:STEPS]


OPERATIONS = {
    "product": (lambda x, y: affine.product(x, y), lambda a, b: a * b),
    "square": (lambda x, y: affine.square(x), lambda a, b: a * a),
    "square_root": (lambda x, y: affine.square_root(x), lambda a, b: np.sqrt(a)),
    "reciprocal": (lambda x, y: affine.reciprocal(x), lambda a, b: 1.0 / a),
    "positive_part": (lambda x, y: affine.positive_part(y), lambda a, b: np.maximum(b, 0.0)),
    "difference": (lambda x, y: affine.difference(x, y), lambda a, b: a - b),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_forms__enclose_what_they_stand_for(name):
    enclose, exact = OPERATIONS[name]
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y = rng.normal(0.0, 0.2, 5), rng.normal(0.0, 0.6, 5)
        x[0], x[-1], y[-1] = 1.5 + rng.random(), abs(x[-1]), abs(y[-1])
        x[1:] *= 1.3 / max(np.abs(x[1:]).sum(), 1.3)
        at = rng.choice([-1.0, 1.0, 0.3], (64, 3))
        a = x[0] + at @ x[1:4] + x[4] * rng.choice([-1.0, 1.0], 64)
        b = y[0] + at @ y[1:4] + y[4] * rng.choice([-1.0, 1.0], 64)
        out = enclose(x, y)
        assert (np.abs(exact(a, b) - out[0] - at @ out[1:4]) <= out[4] + 1e-12).all()


@pytest.mark.parametrize(
    ("text", "horizon", "cells", "harm", "more"),
    [
        ("gaps_m=2", 8.0, 1, 14.0**2 - 2 * 5 * 13, 1e-3),  # 13 m in the worst world
        ("gaps_m=2", 1.2, 1, 14.0**2 - 2 * 5 * 13, 1e-3),  # which meets at 1.18 s, in the last step
        ("gaps_m=2", 1.1, 1, 0.0, 1e-3),
        ("gaps_m=2,speeds_mps.vehicle_2=1", 8.0, 25, 15.0**2 - 2 * 5 * 13, 1.0),
    ],
)
def test_by_hand__two_vehicles_the_bound_up_to_the_horizon_is_that_of_the_least_gap(text, horizon, cells, harm, more):
    assert harm - 1e-9 <= bound_of(boxed(text, STANDING, horizon_s=horizon), np.full(STEPS, -1.0), cells) <= harm + more


@pytest.mark.parametrize(("length", "wide"), [(0.1, 0.1), (1.0, 0.125)])
def test_by_hand__a_gap_in_contact_is_as_wide_as_the_flight_of_its_piece_or_the_highest_one(length, wide):
    # It opens with 1 m/s at most, and 4 m/s2 press it together: 1 / (2 * 4) m.
    case, touch = boxed("gaps_m=1"), np.zeros(TOUCH_WIDTH)
    touch[[OPENING, SOFTEST, HARDEST]] = 1.0, 4.0, 4.0
    bounce(cell_in(case, case.boxes.low[0], np.full(STEPS, -1.0))[0], touch, 0, 4.0, 4.0, length, 0.0)
    assert touch[WIDE] == wide


def test_by_hand__brakes_build_up_from_piece_to_piece():
    # from 0 to 7 m/s2 at 12.65 m/s3: after 0.6 s 7 * 0.6 - 7^2 / (2 * 12.65) m/s slower
    case, plan = boxed("gaps_m=1", brake_rate_mps3=12.65), np.full(STEPS, -1.0)
    cell, _ = cell_in(case, case.boxes.low[0], plan)
    ends = cell.times[1:]
    at = np.flatnonzero((ends > 1e-9) & (ends < 0.6 + 1e-9))
    lost, gain, swing = cell.forces.rise[1, 1 + at], cell.forces.gain[1, 1 + at], cell.forces.swing[1, 1 + at, 0]
    way = gain[:, 0].sum() + (lost[:, 0] * (0.6 - ends[at])).sum()
    assert lost[:, 0].sum() == pytest.approx(0.5 * 7 * 7 / 12.65 - 7 * 0.6)
    assert way == pytest.approx(-0.5 * 7 * 0.6**2 + 0.5 * 7 * 7 / 12.65 * 0.6 - 7**3 / 12.65**2 / 6)
    assert swing == pytest.approx(0.5 * 12.65 * np.diff(cell.times)[at]) and (np.abs(lost[:, -1]) < 1e-12).all()


@pytest.mark.parametrize("name", UNUSUAL)
def test_bound__is_at_least_the_harm_of_every_world_drawn_from_the_box(name):
    (changed, text), rng = UNUSUAL[name], np.random.default_rng(5)
    for first in range(2):
        case = boxed(text, first=first, **changed)
        assert all(harm_inside(*case[:3], plan, 25).max() <= bound_of(case, plan, 5) < np.inf for plan in plans(rng))


# an impact, and then: bounces while they brake to a stop; a pair pressed together, a push beyond a speed limit, a drive
# that begins at an uncertain time and ends at a limit; a light one between two heavy ones
STATES = {
    "bounces": (
        {"gaps_m": [1, 12], "speeds_mps": [10, 12, 10], "restitution": 0.4, "braking_capacity_mps2": [8, 5, 6]},
        "gaps_m.pair_1=0.05,speeds_mps.vehicle_2=0.2",
    ),
    "pressed": (
        {"gaps_m": [2, 9], "speeds_mps": [12, 20, 15], "restitution": 0.2, "braking_capacity_mps2": [8, 5, 6]},
        "speeds_mps.vehicle_1=0.2,mass_t.vehicle_2=5%,latency_s.vehicle_1=0.05",
    ),
    "limits": (
        {
            "gaps_m": [2, 3],
            "speeds_mps": [18, 19, 21],
            "speed_limit_mps": 21.2,
            "driving_capacity_mps2": 5,
            "roles": {"vehicle_1": "constant:-4", "vehicle_2": "learner", "vehicle_3": "coast"},
        },
        "latency_s.vehicle_1=0.1,driving_capacity_mps2.vehicle_2=10%,speeds_mps.vehicle_1=0.2",
    ),
    "build up": (
        {"gaps_m": [2, 9], "speeds_mps": [12, 20, 15], "brake_rate_mps3": [9, 15, 12], "release_rate_mps3": 30},
        "brake_rate_mps3=10%,speeds_mps.vehicle_1=0.2,latency_s.vehicle_1=0.05",
    ),
    "slow": (  # to standstill, and driving on from there
        {
            "gaps_m": [0.6, 0.9],
            "speeds_mps": [2, 2.6, 2.4],
            "speed_limit_mps": 2.7,
            "restitution": 0.2,
            "brake_rate_mps3": [9, 15, 12],
            "release_rate_mps3": [20, 9, 30],
        },
        "brake_rate_mps3=10%,release_rate_mps3.vehicle_2=10%",
    ),
    "light": (
        {"gaps_m": [1, 8], "speeds_mps": [9, 15, 12], "mass_t": [5, 0.3, 4], "restitution": 0.05},
        "gaps_m=0.1,braking_capacity_mps2.vehicle_2=3%",
    ),
}


@pytest.mark.slow  # it compiles again what the kernel has compiled, part by part
@pytest.mark.parametrize("name", STATES)
def test_states__of_every_world_are_those_of_some_path(name):
    (changed, text), rng = STATES[name], np.random.default_rng(2)
    case = boxed(text, **changed)
    for plan in plans(rng, -1.0):
        states, touching, found = outside(case, plan, 12, rng)
        assert found[:3] == [] and 0 < touching < states


@pytest.mark.parametrize(("low", "met"), [(0.05, True), (0.5, False)])
def test_by_hand__an_impact_before_the_first_decision_is_not_waited_for(low, met):
    # 9.5 m/s faster, 1 m apart: they meet 0.1 s after the alert; decisions begin between 0.05 and 0.55 s
    case = boxed("latency_s.vehicle_2=0.25", gaps_m=[1, 30], speeds_mps=[10, 19.5, 10], latency_s=[0.9, 0.3, 0.9])
    box = np.where(case.boxes.high[0] > case.boxes.low[0], low, case.boxes.low[0])
    assert wait(*cell_in(case, box, np.full(STEPS, -1.0))) != met


def test_engine__with_an_uncertain_own_latency_no_world_of_the_box_is_distrusted_or_above_the_bound():
    # vehicle_3 is faster at the alert and brakes through the speed of vehicle_2 then: gap 2 has its extreme in between
    scenario = PAPER.replace(gaps_m=[60, 25], speeds_mps=[20, 20, 21], latency_s=[0, 0.3, 0.8])
    told = scenario.sample(1, 3).worlds.take(np.zeros(4, np.int64))
    uncertainty = parse_uncertainty("latency_s.vehicle_2=0.15")
    driver = ShieldedDriver(
        eb.make_agent("constant:3"), scenario, uncertainty=uncertainty, robust="interior", assumed=told
    )
    episodes = drive(uncertainty.draw(told, np.random.default_rng(1)), driver, scenario, 1)
    shield = episodes.guarded.shield
    assert (
        not shield.memory.distrusted.any()
        and (episodes.ledger.world_harm("first") <= shield.predicted_harm + 1e-9).all()
    )


def test_bound__more_parts_never_make_it_worse():
    case = boxed("gaps_m=0.5", PAPER, seed=7, first=11)
    found = [bound_of(case, np.full(STEPS, -0.9), cells) for cells in (1, 5, 21)]
    assert found[0] >= found[1] >= found[2] > 0.0


def test_shield__coasting_stays_within_the_bound_in_every_world_of_the_box():
    worlds, uncertainty = PAPER.sample(2, 7, first=11).worlds, parse_uncertainty("gaps_m=0.5")
    shield = RobustShield(PAPER, 1, uncertainty=uncertainty, robust="interior")
    shield.begin(worlds, np.arange(2))
    told, kept = [shield.bound.copy()], 0
    while not shield.memory.running.finished.all():
        held, going = shield.memory.backup, ~shield.memory.running.finished
        shield.decide(np.zeros(2))
        told.append(shield.bound.copy())
        same = going & (shield.memory.backup.plan == held.plan).all(axis=1)
        assert (shield.memory.backup.harm[same] == held.harm[same]).all()  # not the lower harm of its corners
        kept += same.sum()
    assert (np.diff(told, axis=0) <= 0.0).all() and kept > 10
    assert (shield.interventions > 0).all() and (shield.interventions < shield.memory.running.steps).any()
    for k in range(2):
        harm = harm_inside(PAPER, worlds.take([k]), uncertainty, shield.memory.backup.plan[k], 300)
        assert harm.max() <= shield.bound[k] <= shield.memory.first_bound[k] < 200.0


# Where a world drawn from a box leaves the enclosure: its states, not only its harm.
ROOM = 1e-7  # for what two ways to compute a state differ by


def follow_paths(cell):
    """Every path at every piece of time, by its number; whether all of them were followed to their end."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    stack, motion, found, whole = new_stack(N, cell.drive.shape[0]), new_motion(N, cell.drive.shape[0]), {}, True
    stack.forms[0, :N], stack.forms[0, N : N + P], stack.size[0] = cell.speed, cell.gap, 1
    worst, out = -np.inf, np.zeros(cell.drive.shape[0])
    while stack.size[0] > 0 and sum(map(len, found.values())) < 20_000:
        stack.size[0] -= 1
        top = stack.size[0]
        here = Path(stack.forms[top].copy(), stack.touch[top].copy(), stack.marks[top].copy())
        while True:
            piece = int(here.marks[2 * P])
            found.setdefault(piece, []).append(Path(*(part.copy() for part in here)))
            if piece == len(cell.action):
                break
            move_alone(cell, here, piece, motion)
            if may_meet_unseen(cell, here, motion):
                whole = False
                break
            worst = meet(cell, here, stack, motion, worst, out)
            if not go_on(cell, here, motion):
                break
            here.marks[2 * P] += 1
    return found, whole and stack.size[0] == 0


def realised(scenario, truth: eb.Worlds, vehicle: int, plan, times):
    """Worlds at each of the times (s after their first decision) under the plan, and their harm so far."""
    command = fixed_commands(script_agents(scenario, except_for=vehicle), truth, "test", vehicle=vehicle).copy()
    first = np.maximum(truth.vehicles.latency_s[:, vehicle], truth.time_s)
    harm, v = np.zeros((truth.n, truth.N - 1)), truth.vehicles
    for j, at in enumerate(times):
        middle = 0.5 * (times[j - 1] + at) if j > 0 else -1.0
        action = plan[min(int(middle / scenario.time_step_s), len(plan) - 1)] if middle > 0.0 else 0.0
        capacity = v.braking_capacity_mps2 if action < 0.0 else v.driving_capacity_mps2
        command[:, vehicle] = action * capacity[:, vehicle]
        truth, impacts = eb.advance(truth, command, until_s=np.maximum(first + at, truth.time_s))
        harm = harm + impacts.first_impact_harm
        yield truth, harm.sum(axis=1)


def outside(case: Case, plan, draws: int, rng) -> tuple[int, int, list[str]]:
    """States looked at, those in which a pair is in contact, and those that no path encloses, of worlds of the box.

    ``follow_paths`` goes the way of ``enclosure.most_harm`` and keeps every path at every piece of time. A state that
    was realised must be that of some path with the same pairs hit. What follows a vehicle that may be thrown backwards
    is told by its harm alone, and not looked at.
    """
    vehicle, low, up = 1, case.boxes.low[0], case.boxes.high[0]
    free = np.flatnonzero(up > low)
    cell, late = cell_in(case, low, plan)
    paths, whole = follow_paths(cell)
    assert wait(cell, late) and whole
    truth = case.uncertainty.draw(case.worlds.take(np.zeros(draws, np.int64)), rng)
    v = truth.vehicles
    numbers = np.concatenate(
        [
            v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, v.brake_rate_mps3,
            v.release_rate_mps3, truth.speeds_mps, truth.gaps_m,
        ],
        1,
    )  # fmt: skip
    at = (numbers[:, free] - 0.5 * (low + up)[free]) / (0.5 * (up[free] - low[free]))
    found, touching, looked = [], 0, 0
    back = np.array([backwards(cell, p) > 0.0 for p in range(truth.N - 1)])
    for piece, (now, harm) in enumerate(realised(case.scenario, truth, vehicle, plan, cell.times)):
        for k in range(draws):
            hit = now.pair_hit[k]
            if hit.all() or (hit & back).any() or now.time_s[k] > case.scenario.horizon_s:
                continue
            looked += 1
            here = [path for path in paths.get(piece, []) if encloses(cell, path, now, harm, k, at[k])]
            touching += any((path.marks[truth.N - 1 : -1] == TOUCHES).any() for path in here)
            if not here:
                found.append(f"piece {piece}, hit {hit}, {now.speeds_mps[k]} m/s, {now.gaps_m[k]} m")
    return looked, touching, found


def encloses(cell, path: Path, now: eb.Worlds, harm, k: int, at) -> bool:
    """Whether world ``k``, at ``at`` [K] in its box, may have gone this path so far."""
    N, P = now.N, now.N - 1
    if not (path.marks[:P] == now.pair_hit[k]).all():
        return False
    exact, room = path.forms[:, 0] + path.forms[:, 1:-1] @ at, path.forms[:, -1] + ROOM
    for p in range(P):
        if path.marks[P + p] == TOUCHES:
            touch = path.touch[p]
            closing = now.speeds_mps[k, p + 1] - now.speeds_mps[k, p]
            if not -touch[OPENING] - ROOM <= closing <= max(touch[CLOSING], 0.0) + ROOM:
                return False
            if now.gaps_m[k, p] > touch[WIDE] + ROOM:
                return False
            apart = max(touch[OPENING], touch[CLOSING], 0.0)
            for side in range(2):
                room[p + side] += high(cell.share[p, side]) * apart + stray(cell, touch, p)
                if 0 <= p - 1 + 2 * side < P:
                    room[N + p - 1 + 2 * side] += high(cell.share[p, side]) * touch[WIDE]
            room[N + p] = np.inf
    state = np.concatenate([now.speeds_mps[k], now.gaps_m[k], harm[k : k + 1]])
    return bool((np.abs(state - exact) <= room).all())


def test_drive_that_a_speed_limit_may_end__gives_any_part_of_its_way() -> None:
    # 20 m/s are its limit: 2 m in 0.1 s, and not the 2.035 m of a drive with 7 m/s2
    case = boxed("gaps_m=1", speeds_mps=20, speed_limit_mps=20, latency_s=0)
    cell, _ = cell_in(case, case.boxes.low[0], np.ones(STEPS))
    path = Path(np.concatenate([cell.speed, cell.gap, 0 * cell.gap[:1]]), np.zeros((2, TOUCH_WIDTH)), np.zeros(5, int))
    move_alone(cell, path, 0, motion := new_motion(3, cell.drive.shape[0]))
    assert [affine.low(motion.reach[1]), affine.high(motion.reach[1])] == pytest.approx([2.0, 2.035], abs=1e-9)


def test_brakes_released_at_standstill__hold_until_the_vehicle_drives() -> None:
    # from -1 to 1 m/s2 in 0.1 s: it stands for 0.05 s, and drives to 0.025 m/s
    motion = new_motion(1, 3)
    motion.vague[0] = 1.0
    hold(np.zeros(3), 0, 0.1, motion)
    assert affine.low(motion.onward[0]) <= 0.0 < 0.025 <= affine.high(motion.onward[0]) <= 0.1 + 1e-12


def test_bound__of_two_that_touch_from_the_alert_on() -> None:
    # gap 0, and pressed together without an impact; then vehicle_2 brakes harder, drives, and strikes
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner"}
    line = {"vehicles": 2, "gaps_m": 0, "speeds_mps": 20, "mass_t": 5, "latency_s": [0, 0.3], "roles": roles}
    line |= {"braking_capacity_mps2": [6, 7], "driving_capacity_mps2": 7}
    case = boxed("braking_capacity_mps2.vehicle_1=2%", **line)
    plan = np.where(np.arange(STEPS) // 6 == 1, 0.9, -1.0)
    assert 1.0 < harm_inside(*case[:3], plan, 50).max() <= bound_of(case, plan, 5)


def test_bound__is_never_above_what_speeds_allow() -> None:
    # a light one, thrown back by a heavy one: no path is followed, and the bound is still a number
    changed, text = UNUSUAL["very unequal masses"]
    case, plan = boxed(text, **changed), np.full(STEPS, -0.9)
    bound, fastest, e = bound_of(case, plan, 1), case.worlds.speeds_mps.max(), 0.3
    assert harm_inside(*case[:3], plan, 50).max() <= bound <= fastest**2 * (1.0 + (1.0 + e) ** 2) + 1e-9
