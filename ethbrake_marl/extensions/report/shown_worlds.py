"""Choice of the worlds that a page shows as episodes: the worst, the avoidable, the typical and some at random."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.summary import BASELINE
from ethbrake_marl.extensions.report.best_known import HARM, BestKnown
from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.motion.layout import Bools, Floats, Ints

MOST_WORLDS = 50
WORST = 10
EACH = 5  # worlds of every kind except the worst and the random ones
TYPICAL = (0.5, 0.6, 0.7, 0.8, 0.9)  # quantiles of the harm
RANDOM_SEED = 0


def choose_shown(result: Result, focus: str, *, most: int = MOST_WORLDS) -> dict[int, Played]:
    """Return at most ``most`` rows to show, each once, in order of their kinds: row -> world, without episodes."""
    first, total = (result[focus][HARM[count]] for count in ("first", "total"))
    known, chosen = BestKnown.of(result), dict[int, Played]()

    def add(kind: str, rows: Iterable[int] | Ints, most_of_kind: int) -> None:
        fresh = [int(row) for row in rows if int(row) not in chosen]
        for row in fresh[: min(most_of_kind, most - len(chosen))]:
            why = f"{focus}: harm {first[row]:.2f} first-impact, {total[row]:.2f} total"
            chosen[row] = Played(int(result.worlds["world"][row]), kind, why)

    add(f"Where {focus} did worst", worst_rows(result, focus), WORST)
    if known is not None and known.avoidable is not None:
        avoidable = result[focus]["collided"] & known.avoidable
        add(f"Avoidable, and {focus} collided", largest(total, avoidable), EACH)
    if BASELINE in result.columns and focus != BASELINE:
        saved = result[BASELINE][HARM["total"]] - total
        add(f"Where {focus} saved most against {BASELINE}", largest(saved, saved > 0.0), EACH)
        add(f"Where {focus} did more harm than {BASELINE}", largest(-saved, saved < 0.0), EACH)
    order = np.argsort(total, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (result.n - 1))] for q in TYPICAL], EACH)
    add("Drawn at random", np.random.default_rng(RANDOM_SEED).permutation(result.n)[: 2 * most], most)
    return chosen


def worst_rows(result: Result, focus: str) -> Ints:
    """Return at most ten rows in which an agent did worst, the worst first: by total harm minus the best known."""
    known = BestKnown.of(result)
    value = result[focus][HARM["total"]] if known is None else known.regret(result, focus, "total")
    return largest(value, value > 0.0)[:WORST]


def largest(value: Floats, among: Bools) -> Ints:
    """Return the rows that are true in ``among``, those with the largest value first."""
    order: Ints = np.argsort(-value, kind="stable")
    return order[among[order]]
