"""The measures ``limits``: the least known harm and honest cost of each world, and an agent's distance from them."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.counts import all_counts
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import best_stored as stored, outdated_tables, shipped_tables
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part


def least_known_values(game: Game, alert: State) -> dict[str, Floats]:
    """Least known value of each count that is known in all worlds, count -> [n] m2/s2, from the shipped tables.

    Raises ``InvalidInput`` if no count is.
    """
    problem = problem_of(game, alert)
    least_values = {count.name: stored(problem, count)[0] for count in all_counts()}
    least_values = {count: values for count, values in least_values.items() if np.isfinite(values).all()}
    if not least_values:
        raise InvalidInput(f"measures limits: {_why_unknown(game.name)}; evaluate the agent best_harm beside yours")
    return least_values


def _why_unknown(scenario: str) -> str:
    headers, outdated = {table.header["scenario"]: table.header for table in shipped_tables()}, outdated_tables()
    if scenario in outdated:
        return outdated[scenario]
    if scenario not in headers:
        return f"scenario {scenario!r} has no table of best known harm"
    header = headers[scenario]
    return (
        f"the table of best known harm for {scenario} holds the first {header['episodes']:,} worlds of seed"
        f" {header['list_seed']}, of the scenario without changes, where {', '.join(header['vehicles'])} learns"
    )


def best_known(game: Game, alert: State, last: State) -> MeasureValue:
    """Least known harm or honest cost of each world, from the shipped tables, count -> [n] m2/s2.

    The result is the same for every agent.
    """
    return least_known_values(game, alert)


def regret(game: Game, alert: State, last: State) -> MeasureValue:
    """Harm (or honest cost) minus the least known in the same world. Below 0: the agent did less than was known."""
    return {count: last.harm(count) - harm for count, harm in least_known_values(game, alert).items()}


SHARE = "How much of what the best known braking saves the agent saves: 0 % for full braking, 100 % for the best known."
LIMITS = {
    "best_known": Part(best_known, unit="m2/s2"),
    "regret": Part(
        regret, unit="m2/s2",
        statistics=(
            Statistic("regret_{count}", "mean", "Regret, {words}", "Regret\n{count}", "{count}"),
            Statistic(
                "share_of_possible_reduction_{count}", "decrease", "Share of possible, {words}", "Possible\n{count}",
                "{count}", SHARE,
            ),
        ),
    ),
}  # fmt: skip
