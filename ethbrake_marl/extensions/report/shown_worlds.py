"""Choice of the worlds that a report shows as episodes: worst worlds, typical worlds, random worlds and others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.extensions.search.regret import regrets_of
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

MOST_WORLDS = 50

WORST = 10

_EACH = 5  # number of worlds of every kind except the worst and the random ones

_RANDOM_SEED = 0

BASELINE = "full_brake"

ROUNDING = 1e-6  # m2/s2

NAMES: dict[HarmCount, str] = {"first": "first_impact_harm", "total": "total_harm"}

WORDS = {
    "Contact": "Two vehicles, or Vehicle 1 and an obstacle, touch: the gap between them is 0.",
    "Impact": "A contact with a closing speed above 0. The square of that speed is its harm.",
    "Collision": "A world with at least one impact.",
}


def choose_shown(evaluation: Evaluation, focus: str, *, most: int = MOST_WORLDS) -> dict[int, Played]:
    """Choose at most ``most`` worlds of an evaluation to show as episodes.

    Return a dictionary from the index of each chosen world to a ``Played`` object without motion (``Played.drive`` adds
    the motion). The worlds are chosen in this order: worlds in which the agent ``focus`` did worst, worlds with an
    avoidable collision, worlds with the largest reduction of harm compared with full braking, worlds with more harm
    than full braking, worlds with typical harm of the agent ``focus``, and random worlds.
    """
    outcome = evaluation.outcome(focus)
    chosen: dict[int, Played] = {}
    total, first = outcome.total_harm, outcome.first_impact_harm

    def add(kind: str, rows: Sequence[int] | Ints, most_of_kind: int) -> None:
        fresh = [int(row) for row in rows if int(row) not in chosen][: min(most_of_kind, most - len(chosen))]
        for row in fresh:
            why = f"{focus}: harm {first[row]:.2f} first-impact, {total[row]:.2f} total"
            chosen[row] = Played(int(evaluation.index[row]), kind, why)

    add(f"Where {focus} did worst", worst_rows(evaluation, focus), WORST)
    regrets = regrets_of(evaluation)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if avoidable is not None:
        add(f"Avoidable, and {focus} collided", _largest(total, outcome.collided & avoidable), _EACH)
    if BASELINE in evaluation.outcomes and focus != BASELINE:
        saved = evaluation.outcome(BASELINE).total_harm - total
        add(f"Where {focus} saved most against {BASELINE}", _largest(saved, saved > 0.0), _EACH)
        add(f"Where {focus} did more harm than {BASELINE}", _largest(-saved, saved < 0.0), _EACH)
    order = np.argsort(total, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (len(order) - 1))] for q in (0.5, 0.6, 0.7, 0.8, 0.9)], _EACH)
    add("Drawn at random", np.random.default_rng(_RANDOM_SEED).permutation(len(total))[: 2 * most], most)
    return chosen


def worst_rows(evaluation: Evaluation, focus: str) -> Ints:
    """Return the indices of at most ten worlds in which the agent ``focus`` did worst, worst first.

    The worst world has the largest regret in total harm or, if the best known harm is not available, the largest total
    harm. Worlds whose regret (or harm) is 0 are omitted.
    """
    outcome, regrets = evaluation.outcome(focus), regrets_of(evaluation)
    value = outcome.total_harm if regrets is None else regrets.regret(outcome, "total")
    return _largest(value, value > 0.0)[:WORST]


def _largest(value: Floats, among: Bools) -> Ints:
    order = np.argsort(-value, kind="stable")
    return order[among[order]]
