"""The measure ``worst5``: the mean of the worst 5 % of the worlds, in every count of harm."""

from __future__ import annotations

from ethbrake_marl.episode.counts import COUNTS, IN_WORDS
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.registry import Part


def worst5(game: Game, alert: State, last: State) -> MeasureValue:
    """Mean of the worst 5 % of the worlds, in each count of harm. In rows per world: the harm or cost of the world."""
    return {count: last.harm(count) for count in COUNTS if count != "honest" or last.is_exact}


WORST5 = Part(
    worst5,
    unit="m2/s2",
    statistics=tuple(
        Statistic(f"worst5_{count}", "worst", f"Worst 5 %, {name}", f"Worst 5 %\n{count}", count)
        for count, name in IN_WORDS.items()
    ),
)
