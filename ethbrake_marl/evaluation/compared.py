"""Teams that drove the same list of worlds, with everything that a page about them needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.door import evaluate
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.worlds.scenario import Scenario


class Compared(NamedTuple):
    """A scenario, the teams, and what they did in the worlds of an evaluation list."""

    scenario: Scenario
    teams: Mapping[str, Team]
    result: Result
    table: SummaryTable
    harm_count: str  # what optimising teams minimise: ``first`` or ``total``

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        teams: Mapping[str, Team],
        *,
        episodes: int,
        seed: int,
        harm_count: str = "first",
        measures: Iterable[str] | str = (),
        jobs: int = 1,
        on_done: Callable[[int], None] | None = None,
    ) -> Compared:
        """Let the teams drive the list; the arguments are those of ``evaluate``."""
        result = evaluate(
            scenario, teams, episodes=episodes, seed=seed, harm_count=harm_count, measures=measures, jobs=jobs,
            on_done=on_done,
        )  # fmt: skip
        return cls(scenario, teams, result, summarise(result), harm_count)

    def worlds(self, rows: Iterable[int] | Ints) -> State:
        """Return the worlds of some rows, at the alert."""
        numbers, seed = self.result.worlds["world"], self.result.about["seed"]
        return State.join([self.scenario.sample(1, seed, first=int(numbers[row])) for row in rows])

    def first(self, count: int) -> Result:
        """Return the result in the first ``count`` worlds."""
        return self.result.take(np.arange(min(count, self.result.n)))
