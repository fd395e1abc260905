"""Tables of an evaluation: one row per agent, and the same outcomes under other objectives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.agents.knowledge import Knowledge, Source, knowledge_text, sees_through
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.conditions import parameters
from ethbrake_marl.evaluation.harm_metrics import COLUMN, metric_headings
from ethbrake_marl.evaluation.identity import policies_by_name, result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.outcome import Evaluation, LeftOut, Outcome
from ethbrake_marl.evaluation.paper import is_papers_test
from ethbrake_marl.evaluation.regret import Distance, assess, distance
from ethbrake_marl.evaluation.statistics import (
    Estimate,
    estimates_to_json,
    mean,
    paired_difference,
    rate,
    relative_decrease,
)
from ethbrake_marl.files.html import html_table
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.objectives import Declared, objectives_of, scored, standard_objectives

ALL = "standard"


@dataclass(frozen=True, slots=True)
class Rescored:
    """One agent under one objective and count: the mean for each vehicle, front to rear (m2/s2); less is better."""

    agent: str
    objective: str
    harm_count: HarmCount
    each: tuple[Estimate, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: objective, harm count, and each vehicle's mean with its interval."""
        each = estimates_to_json({f"vehicle_{i + 1}": estimate for i, estimate in enumerate(self.each)})
        return {"objective": self.objective, "harm_count": self.harm_count, **each}


def declared_objectives(texts: Sequence[str], vehicles: int) -> list[str]:
    """Objectives by name, ``standard`` standing for all that need no knowledge of the scenario.

    Raises ``InvalidInput`` for one that is unknown, given twice, or made for another number of vehicles.
    """
    names = [name for text in texts for name in (standard_objectives() if text == ALL else (text,))]
    for k, name in enumerate(names):
        objectives_of(name, vehicles)
        if name in names[:k]:
            raise InvalidInput(f"objective {name!r} is given twice")
    return names


def rescore(evaluation: Evaluation, declared: Sequence[Declared] | None = None) -> list[Rescored]:
    """Every agent under every objective and both counts, in that order."""
    return [
        Rescored(agent, objective, harm_count, tuple(mean(column) for column in values.T))
        for agent, outcome in evaluation.outcomes.items()
        for harm_count in HARM_COUNTS
        for objective, values in scored(outcome.ledger, harm_count, declared).items()
    ]


def rescored_table(rows: Sequence[Rescored], harm_count: HarmCount) -> Table:
    """The means under one count for a terminal: one line per agent and objective, one column per vehicle."""
    shown = [row for row in rows if row.harm_count == harm_count]
    harm = "first-impact" if harm_count == "first" else "total"
    table = Table(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title=f"Objectives, {harm} harm", title_justify="left"
    )
    table.add_column("Agent", overflow="fold")
    table.add_column("Objective")
    for i in range(len(shown[0].each) if shown else 0):
        table.add_column(f"Vehicle {i + 1}", justify="right", no_wrap=True)
    for k, row in enumerate(shown):
        agent = "" if k and shown[k - 1].agent == row.agent else row.agent
        table.add_row(Text(agent), Text(row.objective), *(f"{estimate.value:.2f}" for estimate in row.each))
    return table


BASELINE = "full_brake"
FAR_M = 5.0  # Vehicle 1 counts as shoved far beyond this


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What one agent achieved over the list of worlds; harms are means per world, m2/s2.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2)
    ('full_brake', 2, 36.99)

    """

    agent: str  # its name
    episodes: int  # worlds
    collisions: int  # worlds with at least one impact
    horizon_ends: int  # worlds that the horizon cut off before the line stood
    collision_rate: Estimate  # share of worlds
    first_impact_harm: Estimate  # each pair's first impact
    total_harm: Estimate  # every impact
    first_difference: Estimate | None  # first-impact harm minus the baseline's, paired by world
    total_difference: Estimate | None  # the same of total harm
    first_decrease: Estimate | None  # 1 - harm / the baseline's harm
    total_decrease: Estimate | None  # the same of total harm
    predicted_harm: Estimate | None  # where the agent predicts, and a finite harm in every world
    policy_share: float | None  # share of worlds in which a hybrid drove by its policy
    parameters: dict[str, Any]  # of the test, for JSON
    distance: Distance = field(default_factory=Distance)  # to the best known harm
    shoved_m: Estimate | None = None  # how far Vehicle 1 ends beyond where it would by itself
    shoved_far: Estimate | None = None  # share of worlds in which that is more than ``FAR_M``
    sampled_harm: Estimate | None = None  # the paper's sum over samples
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    beside_paper: bool = False  # these are results of the test that the paper's rows are about
    knows: Knowledge = (Source.UNSTATED,)  # what the agent says it knows of the line
    hidden_share: float = 0.0  # worlds in which the channel hides something from a driven vehicle, whoever drives
    worlds_sha256: str = ""  # of the list; results on the same worlds have the same
    scenario_sha256: str = ""  # of all that shapes an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives
    versions: Mapping[str, str] = field(default_factory=dict)  # of what computed it
    metrics: Mapping[str, Estimate] = field(default_factory=dict)  # registered harm metrics, mean per world

    @property
    def sees_through(self) -> bool:
        """Whether the channel hides something here that this agent reads all the same."""
        return self.hidden_share > 0.0 and sees_through(self.knows)

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        return {
            "kind": "evaluate",
            "agent": self.agent,
            "knows": knowledge_text(self.knows),
            "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share,
            "episodes": self.episodes,
            "collisions": self.collisions,
            "horizon_ends": self.horizon_ends,
            **estimates_to_json(self._estimates()),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **self._distance_to_json(),
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": metric_headings(self.metrics)} if self.metrics else {}),
            "parameters": self.parameters,
        }

    def _estimates(self) -> dict[str, Estimate | None]:
        """What was measured, by its names in JSON."""
        return {
            "collision_rate": self.collision_rate,
            "first_impact_harm": self.first_impact_harm,
            "total_harm": self.total_harm,
            "sampled_harm": self.sampled_harm,
            "vehicle_1_shoved_m": self.shoved_m,
            "vehicle_1_shoved_far_rate": self.shoved_far,
            "first_impact_harm_difference": self.first_difference,
            "total_harm_difference": self.total_difference,
            "harm_decrease_first": self.first_decrease,
            "harm_decrease_total": self.total_decrease,
            **({"predicted_harm": self.predicted_harm} if self.predicted_harm else {}),
            **{f"{COLUMN}{name}": estimate for name, estimate in self.metrics.items()},
        }

    def _distance_to_json(self) -> dict[str, Any]:
        return {
            **estimates_to_json(self.distance.estimates()),
            "known_best_share": self.distance.known_best_share,
            "best_known_warning": self.distance.warning or None,
            "below_best_known": self.distance.below_best_known,
            "impact_unproven": None if self.distance.between is None else asdict(self.distance.between),
        }


class SummaryTable(list[SummaryRow]):
    """The rows of ``summarise``: a list that a notebook shows as a table.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> isinstance(rows, eb.SummaryTable), len(rows)
    (True, 1)

    """

    def _repr_html_(self) -> str:
        rows = []
        for row in self:
            harms = (row.first_impact_harm, row.total_harm, row.distance.regret_first)
            shares = (row.collision_rate, row.first_decrease, row.distance.realised_first)
            cells = [NO_VALUE if each is None else each.in_words() for each in harms]
            rates = [NO_VALUE if each is None else each.in_words(digits=1, scale=100.0, unit=" %") for each in shares]
            rows.append((row.agent, knowledge_text(row.knows), *rates[:1], *cells, *rates[1:]))
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += f" WARNING: {self[0].distance.warning}." if self and self[0].distance.warning else ""
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        return html_table(_HEAD, rows, caption=worlds, note=note)


NO_VALUE = "–"
_HEAD = (
    "Agent",
    "Knows",
    "Collisions",
    "First-impact harm",
    "Total harm",
    "Regret, first",
    "Decrease, first",
    "Realised share, first",
)


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE) -> SummaryTable:
    """One row per agent, in the order of the evaluation; compared with ``baseline`` where that was evaluated."""
    conditions = parameters(evaluation)
    reference = evaluation.outcomes.get(baseline)
    beside, regrets, braking = is_papers_test(evaluation), assess(evaluation), evaluation.outcomes.get(BASELINE)
    hidden = float(evaluation.hidden.mean())
    worlds, scenario = worlds_sha256(evaluation.worlds, evaluation.index), scenario_sha256(evaluation.scenario)
    versions = result_versions()
    rows = [_row(agent, outcome, reference, conditions) for agent, outcome in evaluation.outcomes.items()]
    return SummaryTable(
        replace(
            row,
            beside_paper=beside,
            left_out=evaluation.left_out,
            distance=distance(regrets, evaluation.outcome(row.agent), braking),
            knows=evaluation.outcome(row.agent).knows,
            hidden_share=hidden,
            worlds_sha256=worlds,
            scenario_sha256=scenario,
            policy_sha256=policies_by_name(evaluation.outcome(row.agent).policies, evaluation.scenario),
            versions=versions,
        )
        for row in rows
    )


def horizon_note(moving: Mapping[str, int], worlds: int, horizon_s: float) -> str:
    """What must be said of shielded drivers: in how many worlds, by driver, something still ``moving`` was cut off.

    Empty where there is nothing to say.
    """
    found = ", ".join(f"{name} {count}" for name, count in moving.items() if count)
    if not found:
        return ""
    return (
        f"note: bounds of the shield end at the horizon ({horizon_s:g} s) and say nothing of what comes after;"
        f" worlds, of {worlds}, that were not at rest then: {found}"
    )


def _row(agent: str, outcome: Outcome, reference: Outcome | None, conditions: dict[str, Any]) -> SummaryRow:
    first, total = outcome.first_impact_harm, outcome.total_harm
    collisions, episodes = int(outcome.collided.sum()), len(first)
    against = None if reference is None else (reference.first_impact_harm, reference.total_harm)
    predicted = outcome.predicted_harm
    return SummaryRow(
        agent=agent,
        episodes=episodes,
        collisions=collisions,
        horizon_ends=int((~outcome.at_rest).sum()),
        collision_rate=rate(collisions, episodes),
        first_impact_harm=mean(first),
        total_harm=mean(total),
        first_difference=None if against is None else paired_difference(first, against[0]),
        total_difference=None if against is None else paired_difference(total, against[1]),
        first_decrease=None if against is None else relative_decrease(first, against[0]),
        total_decrease=None if against is None else relative_decrease(total, against[1]),
        predicted_harm=None if predicted is None or not np.isfinite(predicted).all() else mean(predicted),
        policy_share=None if outcome.chosen_policy is None else float(outcome.chosen_policy.mean()),
        parameters=conditions,
        shoved_m=None if outcome.shoved_m is None else mean(outcome.shoved_m),
        shoved_far=None if outcome.shoved_m is None else rate(int((outcome.shoved_m > FAR_M).sum()), episodes),
        sampled_harm=None if outcome.sampled_harm is None else mean(outcome.sampled_harm),
        metrics={name: mean(column) for name, column in outcome.metrics.items()},
    )
