"""The table and the results file of a list that was evaluated in shards, from its merged tally alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.evaluation.conditions import parameters_of
from ethbrake_marl.evaluation.exact import Moments, difference
from ethbrake_marl.evaluation.harm_metrics import COLUMN
from ethbrake_marl.evaluation.paper import is_papers_list
from ethbrake_marl.evaluation.regret import Distance
from ethbrake_marl.evaluation.results_file import results_to_json
from ethbrake_marl.evaluation.shards.columns import HARM_NAMES, REGRET_NAMES, objective_column
from ethbrake_marl.evaluation.shards.question import Asked
from ethbrake_marl.evaluation.shards.tally import AgentTally, Tally
from ethbrake_marl.evaluation.statistics import Estimate, decrease_of, estimates_to_json, exact_rate, mean_of
from ethbrake_marl.evaluation.table import BASELINE, Rescored, SummaryRow
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.scenario.quantities import DECLARED

INTERVALS = {"rates": "Clopper-Pearson", "means": "Student's t, of exact sums"}


class _Agent:
    """What one agent did in all worlds of a list; what only some worlds have is not told."""

    def __init__(self, tally: AgentTally, baseline: AgentTally | None, worlds: int) -> None:
        self._tally, self._baseline, self._worlds = tally, baseline, worlds

    def count(self, name: str) -> int:
        """Worlds in which something was so."""
        return self._tally.counts.get(name, 0)

    def share(self, name: str) -> Estimate:
        """Their share, with the exact interval."""
        return exact_rate(self.count(name), self._worlds)

    def share_if_counted(self, name: str) -> Estimate | None:
        """Their share; None where nobody counted, not even to 0."""
        return self.share(name) if name in self._tally.counts else None

    def _whole(self, tally: AgentTally | None, name: str) -> Moments | None:
        found = None if tally is None else tally.moments.get(name)
        return found if found is not None and found.count == self._worlds else None

    def mean(self, name: str) -> Estimate | None:
        """The mean of a number; None unless every world has it."""
        found = self._whole(self._tally, name)
        return None if found is None else mean_of(found)

    def needed(self, name: str) -> Estimate:
        """The mean of a number that every world has."""
        return mean_of(self._tally.moments[name])

    def against(self, name: str) -> Estimate | None:
        """The difference to the baseline, paired by world."""
        one, other = self._whole(self._tally, name), self._whole(self._baseline, name)
        if one is None or other is None:
            return None
        return mean_of(difference(one, other, self._tally.products[name]))

    def decrease(self, name: str) -> Estimate | None:
        """1 - mean / the baseline's mean, paired by world."""
        one, other = self._whole(self._tally, name), self._whole(self._baseline, name)
        return None if one is None or other is None else decrease_of(one, other, self._tally.products[name])

    def distance(self) -> Distance:
        """What was avoidable, and how far it stayed from the best known; all None unless that is known everywhere."""
        if self.count("known") != self._worlds:
            return Distance()
        return Distance(
            unavoidable_rate=self.share_if_counted("unavoidable"),
            impact_proven_rate=None if self.mean("proven_harm") is None else self.share("impact_proven"),
            avoidable_collision_rate=self.share_if_counted("avoidable_collisions"),
            best_known_first=self.mean("best_known_first"),
            best_known_total=self.mean("best_known_total"),
            proven_harm=self.mean("proven_harm"),
            gap_first=self.mean("gap_first"),
            gap_total=self.mean("gap_total"),
            regret_first=self.mean(REGRET_NAMES["first"]),
            regret_total=self.mean(REGRET_NAMES["total"]),
            realised_first=self.decrease(REGRET_NAMES["first"]),
            realised_total=self.decrease(REGRET_NAMES["total"]),
            known_best_share=1.0,
            below_best_known=self.count("below_best_known"),
        )


def _agents(tally: Tally) -> dict[str, _Agent]:
    baseline = tally.agents.get(BASELINE)
    return {name: _Agent(each, baseline, tally.worlds) for name, each in tally.agents.items()}


def summarise_shards(asked: Asked, tally: Tally) -> list[SummaryRow]:
    """One row per agent, as ``summarise``; rates with exact intervals. Raises ``PhysicsError`` if no world is left."""
    if not tally.worlds:
        raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in tally.left_out})
    question = asked.question
    told = {name: _told_range(name, entries) for name, entries in tally.ranges.items()}
    conditions = parameters_of(question.task, question.seed, tally.worlds, asked.because, told)
    agents = _agents(tally)
    return [_row(asked, tally, name, agents[name], conditions) for name in asked.identity["agents"]]


def _row(asked: Asked, tally: Tally, name: str, found: _Agent, conditions: dict[str, Any]) -> SummaryRow:
    question, shoved, hybrid = asked.question, found.mean("shoved_m"), found.count("hybrid") == tally.worlds
    columns = [column for column in tally.agents[name].moments if column.startswith(COLUMN)]
    return SummaryRow(
        agent=name,
        episodes=tally.worlds,
        collisions=found.count("collisions"),
        horizon_ends=found.count("horizon_ends"),
        collision_rate=found.share("collisions"),
        first_impact_harm=found.needed(HARM_NAMES["first"]),
        total_harm=found.needed(HARM_NAMES["total"]),
        first_difference=found.against(HARM_NAMES["first"]),
        total_difference=found.against(HARM_NAMES["total"]),
        first_decrease=found.decrease(HARM_NAMES["first"]),
        total_decrease=found.decrease(HARM_NAMES["total"]),
        predicted_harm=found.mean("predicted_harm"),
        policy_share=found.count("policy") / tally.worlds if hybrid else None,
        parameters=conditions,
        distance=found.distance(),
        shoved_m=shoved,
        shoved_far=None if shoved is None else found.share("shoved_far"),
        sampled_harm=found.mean("sampled_harm"),
        left_out=tally.left_out,
        beside_paper=is_papers_list(question.scenario, question.seed, question.task.vehicles),
        knows=asked.knows[name],
        hidden_share=tally.hidden / tally.worlds,
        worlds_sha256=f"{tally.worlds_hash:064x}",
        scenario_sha256=asked.identity["scenario_sha256"],
        policy_sha256=asked.policies[name],
        versions=asked.identity["versions"],
        metrics={column.removeprefix(COLUMN): found.needed(column) for column in columns},
    )


def rescore_shards(asked: Asked, tally: Tally) -> list[Rescored]:
    """Every agent under every objective of the question and both counts, as ``rescore``."""
    agents, vehicles = _agents(tally), range(asked.question.scenario.vehicles)
    return [
        Rescored(
            name, each, harm_count, tuple(agents[name].needed(objective_column(each, harm_count, i)) for i in vehicles)
        )
        for name in asked.identity["agents"]
        for harm_count in HARM_COUNTS
        for each in asked.question.objectives
    ]


def shards_to_json(asked: Asked, tally: Tally, rows: Sequence[SummaryRow]) -> list[dict[str, Any]]:
    """What a results file holds: one object per agent, each vehicle's harm and the kind of the intervals among it."""
    question, agents = asked.question, _agents(tally)
    settings = {"harm_count": question.harm_count, "uncertainty": question.uncertainty}
    found = results_to_json(rows, told=rescore_shards(asked, tally), settings=settings)
    names = [f"{name}_{i + 1}" for name in HARM_NAMES.values() for i in range(question.scenario.vehicles)]
    return [
        {
            **row,
            "kind": "evaluate-shards",
            "intervals": INTERVALS,
            "vehicle_harm": estimates_to_json({name: agents[row["agent"]].mean(name) for name in names}),
        }
        for row in found
    ]


def _told_range(name: str, entries: Sequence[tuple[float, float]]) -> Any:
    """As ``conditions.quantities`` tells it."""
    told = [low if low == high else [low, high] for low, high in entries]
    return told[0] if DECLARED[name].per == "world" else told
