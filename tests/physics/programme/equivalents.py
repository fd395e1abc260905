"""Mutants that compute the same as the code, each with the reason why no test can kill it.

The number in brackets tells apart the places of one file where the same change is possible.
"""

from __future__ import annotations

SHARED_ROW = "shares a row of the table with one whose values are never needed at the same time: "
MARK = "a mark: only told apart from the others"
UNUSED_FIRST = "the value for the first vehicle is never used"
NO_LIST = "a forecast keeps no list of impacts, which alone would show it"

EQUIVALENT: dict[str, str] = {
    "impact.py: 1.0 -> 2.0 in `1.0` (1)": "STRUCK is a mark: it is only compared with 0",
    "impact.py: `approaching = False` removed (2)": "resolving a cluster in which nobody approaches changes no bit",
    "impact.py: False -> True in `False` (1)": "resolving a cluster in which nobody approaches changes no bit",
    "impact.py: Gt -> GtE in `table[CLOSING, last] > 0.0` (1)": "so does a cluster that only touches: no bit changes",
    "impact.py: Lt -> LtE in `first < pairs` (1)": "the last vehicle on its own is no cluster: nothing is done",
    "impact.py: 12 -> 13 in `12` (1)": "one more row of the table, which nobody uses",
    "impact.py: 7 -> 8 in `7` (1)": SHARED_ROW + "STRUCK (read right after an impact) and BLOCK_MASS (while pooling)",
    "segment.py: 4 -> 5 in `4` (1)": SHARED_ROW + "ACCELERATION and FORCE_LOW, whose entries are read before",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 5` (1)": SHARED_ROW + "FORCE_LOW and STRUCK (read right after an impact)",
    "segment.py: 6 -> 7 in `6` (1)": SHARED_ROW + "FORCE_HIGH (used up by accelerate) and SPEED_TIME (filled after it)",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 6` (1)": SHARED_ROW + "FORCE_HIGH and CONTACT_SPEED (filled after it)",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 7` (1)": SHARED_ROW
    + "SPEED_TIME and CLOSING (filled and read by impacts)",
    "segment.py: 9 -> 10 in `9` (1)": SHARED_ROW + "WAY (only within move_apart) and JOINED (never there)",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 9` (1)": SHARED_ROW
    + "WAY (within move_apart) and POOLED (within an impact)",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 10` (1)": SHARED_ROW + "JOINED and BEFORE (read right after an impact)",
    "segment.py: Add -> Sub in `IMPACT_ROWS + 14` (1)": "row -2 of a table of 28 rows is row 26, the same one",
    "segment.py: 16 -> 17 in `16` (1)": "one more row of the table, which nobody uses",
    "segment.py: 3 -> 4 in `3` (1)": MARK,
    "segment.py: `slowest_in_front, front_steady = (math.inf, 0.0)` removed (1)": UNUSED_FIRST,
    "segment.py: 0.0 -> 1.0 in `0.0` (20)": UNUSED_FIRST,
    "segment.py: Gt -> GtE in `i > 0` (1)": "nothing in front is infinitely fast: vehicle 0 never closes",
    "segment.py: `table[CONTACT_SPEED, i] = 0.0` removed (1)": "every segment ends with 0 there: an impact uses it up",
    "segment.py: 0.0 -> 1.0 in `0.0` (7)": "where the contact time is infinite, `move` puts the speed to 0",
    "segment.py: Gt -> GtE in `first > 0` (1)": "index -1 is the column behind the last pair, always 0",
    "advance.py: 0 -> 1 in `0` (2)": "all of the arrays have as many rows as the first one",
    "advance.py: 11 -> 12 in `11` (1)": MARK,
    "advance.py: 1 -> 2 in `1` (8)": "the world is read only where the status tells of a failure",
    "advance.py: sign dropped in `-1` (1)": "the world is read only where the status tells of a failure",
    "advance.py: 0 -> 1 in `0` (6)": "room for a list that is not given back",
    "advance.py: 4 -> 5 in `4` (1)": "the first guess of the list's length: it grows when needed",
    "advance.py: 64 -> 65 in `64` (1)": "the first guess of the list's length: it grows when needed",
    "events.py: Lt -> LtE in `acceleration < 0.0` (1)": "an acceleration of 0 has returned before",
    "events.py: Gt -> GtE in `acceleration > 0.0` (1)": "an acceleration of 0 has returned before",
    "events.py: Gt -> GtE in `speed > 0.0` (2)": "a speed of 0 is excluded beside it",
    "events.py: Lt -> LtE in `speed < limit` (2)": "a speed at the limit is excluded beside it",
    "events.py: Lt -> LtE in `command < 0.0` (2)": "a command of 0 gives 0 by either branch",
    "events.py: Gt -> GtE in `command > 0.0` (2)": "a command of 0 gives 0 by either branch",
    "events.py: Gt -> GtE in `low > 0.0` (1)": "0 by either branch",
    "events.py: Lt -> LtE in `high < 0.0` (1)": "0 by either branch",
    "events.py: Gt -> GtE in `command > 0.0` (1)": "a command of 0 keeps the speed by either branch",
    "forecast.py: 0 -> 1 in `0` (2)": NO_LIST,
    "forecast.py: 0 -> 1 in `0` (1)": NO_LIST,
    "forecast.py: 0.0 -> 1.0 in `0.0` (1)": NO_LIST,
    "forecast.py: 1.0 -> 2.0 in `1.0` (1)": "only the list of impacts takes it for more than not 0",
    "forecast.py: 1 -> 2 in `1` (1)": MARK + ": below 0",
    "sampled.py: LtE -> Lt in `closing <= 0.0` (1)": "an exchange at closing speed 0 changes nothing, a touch",
    "sampled.py: Lt -> LtE in `command < 0.0` (1)": "a command of 0 keeps the speed by either branch",
    "sampled.py: Gt -> GtE in `command > 0.0` (1)": "a command of 0 keeps the speed by either branch",
    "sampled.py: GtE -> Gt in `speed >= 0.0` (1)": "braking at standstill gives 0 by either branch",
    "sampled.py: Lt -> LtE in `speed < limit` (1)": "driving at the limit is cut to the limit",
    "sampled.py: `way_in_front = 0.0` removed (1)": UNUSED_FIRST,
    "sampled.py: `way_in_front = 0.0` removed (2)": UNUSED_FIRST,
    "sampled.py: 0.0 -> 1.0 in `0.0` (4)": UNUSED_FIRST,
    "sampled.py: 0.0 -> 1.0 in `0.0` (5)": UNUSED_FIRST,
    "sampled.py: 1.0 -> 2.0 in `1.0` (1)": MARK + ": below 0",
    "sampled.py: 1.0 -> 2.0 in `1.0` (2)": MARK + ": below 0",
    "parallel.py: Sub -> Add in `parts - 1` (1)": "a pool starts a thread for a task at most, and gets parts - 1 tasks",
    "parallel.py: `Result = TypeVar('Result')` removed (1)": "only the type checker, which finds it, uses the name",
    "packed.py: 4 -> 5 in `4` (2)": "floor division by 8 gives N for 8 N (4 more than the columns) and for 8 N + 1",
    "packed.py: 3 -> 4 in `3` (2)": "one more group of columns, which nobody takes",
    "harm.py: LtE -> Lt in `front_mass <= rear_mass` (1)": "equal masses: half of the harm by either branch",
    "obstacle.py: 1e+300 -> 2e+300 in `1e+300` (1)": "twice as far away is as far away: nothing comes near",
    "impact.py: 0.0 -> 1.0 in `0.0` (12)": "any finite number divided by an infinite mass is 0",
    "impact.py: 0.0 -> 1.0 in `0.0` (13)": "any finite number divided by an infinite mass is 0",
}
