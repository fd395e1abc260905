"""Results of several teams in the same worlds, with everything that a report about them needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.evaluate import Result, evaluate
from ethbrake_marl.evaluation.measure_registry import split_names
from ethbrake_marl.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.worlds.scenario import Scenario


class Comparison(NamedTuple):
    scenario: Scenario
    teams: Mapping[str, Team]
    result: Result
    table: SummaryTable
    harm_count: HarmCount  # what optimising teams minimise

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        teams: Mapping[str, Team],
        *,
        harm_count: AnyCount = HONEST,
        measures: Iterable[str] | str = (),
        **more: Any,
    ) -> Comparison:
        """Evaluate the teams by ``evaluate(..., **more)``.

        For a count that requires exact impacts, the measure ``pushed_mps`` is added.
        """
        count = HarmCount.of(harm_count)
        names = split_names(measures) if isinstance(measures, str) and measures else [*measures]
        if count.requires:
            names.insert(0, "pushed_mps")
        result = evaluate(scenario, teams, harm_count=count, measures=names, **more)
        return cls(scenario, teams, result, summarise(result), count)

    def worlds(self, rows: Iterable[int] | Ints) -> State:
        numbers, seed = self.result.worlds["world"], self.result.about["seed"]
        return State.join([self.scenario.sample(1, seed, first=int(numbers[row])) for row in rows])
