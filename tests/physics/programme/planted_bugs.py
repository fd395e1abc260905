"""Twenty-seven bugs that such a simulator could have: planted in a copy of the repository, each must turn a test red.

``make planted-bugs`` (or ``python -m tests.physics.programme.planted_bugs [--jobs J] [--only WORD]``). A bug is a
textual patch of the kernel, the ledger, the lower bound or the search. It is applied to a temporary copy, never to the
working tree. There some test files run with compilation switched off (10 s), and where these stay green the whole
suite of the physics, compiled; until the first failure. The first suite is tried without any bug before: it must be
green. (The second one is what ``make test`` runs.) A patch that does not fit the code is an error.
"""

from __future__ import annotations

import sys

from tests.programme.planting import Patch, try_bugs

BY_HAND = (
    "tests/physics/test_instants.py::test_plastic_cluster__three_vehicles_do_not_hand_the_last_bit_to_and_fro",
    "tests/limits/test_lower_bound.py::test_front_pair__by_hand",
    "tests/limits/test_lower_bound_conditions.py",
    "tests/limits/test_best_harm.py::test_even_grid__ends_at_the_capacities_to_the_bit",
)
QUICK = (
    "tests/physics/test_advance.py",
    "tests/physics/test_ties.py",
    "tests/physics/test_against_exact.py",
    "tests/test_harm.py",
    "tests/physics/test_obstacle.py",
    *BY_HAND,
)
WHOLE = ("tests/physics", "tests/golden/test_golden.py", "tests/test_harm.py")

EVENTS, IMPACT, SEGMENT, ADVANCE = (
    "ethbrake_marl/physics/kernel.py",
    "ethbrake_marl/physics/kernel.py",
    "ethbrake_marl/physics/kernel.py",
    "ethbrake_marl/physics/batch.py",
)
HARM, WORLDS = "ethbrake_marl/harm.py", "ethbrake_marl/physics/worlds.py"
FLIGHTS, LOWER_BOUND = ("ethbrake_marl/limits/lower_bound.py", "ethbrake_marl/limits/lower_bound.py")
PROFILES = "ethbrake_marl/search.py"


BUGS: dict[str, tuple[Patch, ...]] = {
    "wrong sign in eq. (13)": (
        Patch(
            IMPACT,
            "table[ROW.SPEED, i] = pooled + bounce * (pooled - table[ROW.SPEED, i])",
            "table[ROW.SPEED, i] -= (1.0 + bounce) * (pooled - table[ROW.SPEED, i])",
        ),
    ),
    "masses swapped in an impact": (
        Patch(IMPACT, "rest += table[ROW.MASS, i] *", "rest += table[ROW.MASS, head + end - 1 - i] *"),
    ),
    "root missed: a pair that opens now never meets": (
        Patch(EVENTS, "    if pressing > 0.0:\n        speed =", "    if pressing > 1e9:\n        speed ="),
    ),
    "textbook root that loses its digits": (
        Patch(
            EVENTS,
            "return 2.0 * gap / (closing + speed), speed",
            "return (gap / closing if pressing == 0.0 else (speed - closing) / pressing), speed",
        ),
    ),
    "bounce-back clamped at standstill": (
        Patch(
            IMPACT,
            "table[ROW.SPEED, i] = pooled + bounce * (pooled - table[ROW.SPEED, i])",
            "table[ROW.SPEED, i] = max(pooled + bounce * (pooled - table[ROW.SPEED, i]), 0.0)",
        ),
    ),
    "late latency: counted from the segment's start": (
        Patch(
            ADVANCE,
            "table[ROW.ONSET, at + i] = onset_s(latency[k, i], time[k])",
            "table[ROW.ONSET, at + i] = latency[k, i]",
        ),
    ),
    "latency rounded up to the end of the step": (
        Patch(
            ADVANCE,
            "table[ROW.ONSET, at + i] = onset_s(latency[k, i], time[k])",
            "table[ROW.ONSET, at + i] = latency[k, i] - time[k] if latency[k, i] <= time[k] else until[k] - time[k]",
        ),
    ),
    "every impact counted as a first one": (
        Patch(SEGMENT, "if table[ROW.HIT, p] == 0.0:", "if table[ROW.HIT, p] >= 0.0:"),
    ),
    "harm counted while vehicles merely touch": (
        Patch(
            IMPACT,
            "table[ROW.STRUCK, p] = 1.0 if table[ROW.CLOSING, p] > BOUND.TOUCH_SPEED_MPS else 0.0",
            "table[ROW.STRUCK, p] = 1.0 if table[ROW.GAP, p] <= 0.0 else 0.0",
        ),
    ),
    "plastic threshold ignored": (
        Patch(IMPACT, "bounce = restitution if largest >= BOUND.PLASTIC_SPEED_MPS else 0.0", "bounce = restitution"),
    ),
    "holding brake slips": (Patch(EVENTS, "        return command, -command\n", "        return 0.0, 0.0\n"),),
    "common acceleration of a block not weighted by mass": (
        Patch(IMPACT, "        mass = table[ROW.MASS, i]\n", "        mass = 1.0\n"),
    ),
    "braking passes through standstill": (
        Patch(EVENTS, "        if after <= 0.0:\n", "        if after <= -1e9:\n"),
        Patch(EVENTS, "== (acceleration < 0.0) and speed != 0.0:", "== (acceleration < 0.0) and command > 0.0:"),
    ),
    "speed limit overshot": (
        Patch(EVENTS, "        if after >= limit:\n", "        if after >= 2.0 * limit:\n"),
        Patch(EVENTS, "reach = (limit - speed) / acceleration", "reach = (2.0 * limit - speed) / acceleration"),
    ),
    "gap not put to zero at contact": (
        Patch(
            SEGMENT, "table[ROW.GAP, p] = 0.0\n            continue", "table[ROW.GAP, p] = 1e-9\n            continue"
        ),
    ),
    "contact at the very end of a segment dropped": (
        Patch(
            SEGMENT,
            "        if resolve_impacts(table, restitution):\n            return FLAG.IMPACT, now\n"
            "        if now >= duration:\n            return FLAG.DONE, now\n",
            "        if now >= duration:\n            return FLAG.DONE, now\n"
            "        if resolve_impacts(table, restitution):\n            return FLAG.IMPACT, now\n",
        ),
    ),
    "restitution e used as 1 - e": (
        Patch(ADVANCE, "advance_table(table, restitution[k],", "advance_table(table, 1.0 - restitution[k],"),
    ),
    "restitution with the wrong sign": (
        Patch(ADVANCE, "advance_table(table, restitution[k],", "advance_table(table, -restitution[k],"),
    ),
    "simultaneous impacts resolved pair after pair": (
        Patch(
            IMPACT,
            "while last < pairs and table[ROW.GAP, last] <= 0.0:",
            "while last < pairs and table[ROW.GAP, last] <= 0.0 and last == first:",
        ),
    ),
    "shares of harm given to the wrong vehicle": (
        Patch(HARM, "return rear_mass / (front_mass + rear_mass)", "return front_mass / (front_mass + rear_mass)"),
    ),
    "obstacle that gives way a little": (
        Patch(WORLDS, "ahead(math.inf, vehicles.mass_t)", "ahead(1e9, vehicles.mass_t)"),
    ),
    "harm of an impact with the obstacle shared as with a vehicle": (
        Patch(
            HARM, "harm[:, 0] += self.obstacle_harm(harm_count)", "harm[:, 0] += 0.5 * self.obstacle_harm(harm_count)"
        ),
    ),
    "later impacts with the obstacle counted as first ones": (
        Patch(
            WORLDS,
            "np.concatenate([self.obstacle_hit[:, np.newaxis], self.pair_hit], axis=1)",
            "np.concatenate([False & self.obstacle_hit[:, np.newaxis], self.pair_hit], axis=1)",
        ),
    ),
    "plastic cluster left out of order by a last digit": (
        Patch(IMPACT, "    if bounce == 0.0:\n", "    if bounce == -1.0:\n"),
    ),
    "lower bound: a flight that costs no command": (
        Patch(FLIGHTS, "return relative - reach * flight + math.sqrt(inside)", "return relative"),
    ),
    "lower bound not rounded outward": (
        Patch(LOWER_BOUND, "np.maximum(part - rounding(worlds, vehicle), 0.0)", "np.maximum(part, 0.0)"),
    ),
    "search that starts an ulp beyond the capacity": (
        Patch(PROFILES, "np.minimum(low + share * (high - low), high)", "low + share * (high - low)"),
    ),
}

if __name__ == "__main__":
    sys.exit(try_bugs("planted bugs", BUGS, QUICK, WHOLE, jobs=2))
