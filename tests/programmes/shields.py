"""Attacks on the shield: harm must equal the certified harm to the bit, and never exceed the bound at the alert.

PettingZoo, vector, VecEnv and evaluation (the other interfaces agree with these), one to four learners, with and
without obstacle, brakes that build up, scripts that react, both counts of harm, every way to propose of
``tests/shields/attack.py``.
"""

from functools import partial

from tests.programmes import Cases, Given, Told
from tests.shields.attack import LINES, ONE, ONLY_ONE, PLAYS, WAYS, Total, attack

SHARES = {"parallel": 0.06, "vector": 0.28, "VecEnv": 0.28, "drive": 0.26, "search": 0.12}
DECISIONS = 45  # of an episode, about; of a search nine times as many

OPTIONS = {
    "--decisions": {"type": int, "default": 2_000_000, "help": "decisions in all, about"},
    "--seed": {"type": int, "default": 1},
}


def cases(given: Given) -> Cases:
    for play, share in SHARES.items():
        lines = ONE if play in ONLY_ONE else LINES
        each = DECISIONS * (9 if play == "search" else 1)
        worlds = round(given.decisions * share / len(lines) / (2 * len(WAYS)) / each)
        for name in lines:
            yield f"{play}: {name}", partial(attacked, play, name, max(1, worlds), given.seed)


def attacked(play: str, name: str, worlds: int, seed: int) -> Told:
    ways = [(count, way) for count in ("first", "total") for way in WAYS]
    results = [attack(play, name, count, way, worlds, seed + k) for k, (count, way) in enumerate(ways)]
    found = Total(*(sum(column) for column in zip(*results, strict=True)))
    return Told(
        found.held,
        f"{found.episodes:,} episodes, {found.decisions:,} decisions, above the bound {found.above}, harm not as"
        f" certified {found.unequal}, bound rose {found.rises}",
    )


assert SHARES.keys() == PLAYS.keys()
