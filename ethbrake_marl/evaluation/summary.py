"""Tables of an evaluation: one row per agent, and the same outcomes under other objectives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Knowledge, Source, knowledge_text, sees_through
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, count_of, unknown_name
from ethbrake_marl.evaluation.inputs import policies_by_name, result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.measures import (
    BASELINE,
    BELOW,
    CHOSEN,
    COLUMN,
    HORIZON,
    KNOWN,
    AgentTally,
    Between,
    between_of,
    estimate_all,
    measures,
    metric_headings,
    metric_meanings,
    tally_agents,
)
from ethbrake_marl.evaluation.outcome import (
    PAPER_NOTE,
    PAPER_PARAMETERS,
    PAPER_ROWS,
    Evaluation,
    LeftOut,
    is_papers_test,
    parameter_line,
    parameters,
)
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.files.sheet import DASH, Column, Estimate, Row, Sheet, Shown, estimates_to_json
from ethbrake_marl.harm import Declared, objectives_of, scored, standard_objectives
from ethbrake_marl.limits.limits import Limits

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


def rescored_table(rows: Sequence[Rescored], harm_count: HarmCount) -> Sheet:
    """The means under one count: one line per agent and objective, one column per vehicle."""
    shown = [row for row in rows if row.harm_count == harm_count]
    vehicles = range(len(shown[0].each) if shown else 0)
    columns: list[Column | str] = [
        "Agent",
        "Objective",
        *(Column(f"Vehicle {i + 1}", interval="hidden") for i in vehicles),
    ]
    names = ["" if k and shown[k - 1].agent == row.agent else row.agent for k, row in enumerate(shown)]
    lines = [(name, row.objective, *row.each) for name, row in zip(names, shown, strict=True)]
    return Sheet(f"Objectives, {'first-impact' if harm_count == 'first' else 'total'} harm", columns, lines)


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What one agent achieved over the list of worlds; harms are means per world, m2/s2.

    ``row["harm_decrease_total"]`` is the estimate of any measure, by its name in JSON; None where it does not exist.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2), rows[0]["predicted_harm"]
    ('full_brake', 2, 36.99, None)

    """

    agent: str  # its name
    episodes: int  # worlds
    estimates: Mapping[str, Estimate | None]  # of every measure, by its name in JSON
    collisions: int  # worlds with at least one impact
    horizon_ends: int  # worlds that the horizon cut off before the line stood
    parameters: dict[str, Any]  # of the test, for JSON
    policy_share: float | None = None  # share of worlds in which a hybrid drove by its policy
    known_best_share: float | None = None  # worlds whose best is known without the agents of this evaluation
    below_best_known: int | None = None  # worlds in which the agent is below it
    between: Between | None = None  # the worlds in which contact is proven and no impact
    warning: str = ""  # a table of best known harm holds some of the worlds, and not the others
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    beside_paper: bool = False  # these are results of the test that the paper's rows are about
    knows: Knowledge = (Source.UNSTATED,)  # what the agent says it knows of the line
    hidden_share: float = 0.0  # worlds in which the channel hides something from a driven vehicle, whoever drives
    worlds_sha256: str = ""  # of the list; results on the same worlds have the same
    scenario_sha256: str = ""  # of all that shapes an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives
    versions: Mapping[str, str] = field(default_factory=dict)  # of what computed it

    def __getitem__(self, measure: str) -> Estimate | None:
        return self.estimates[measure]

    def _needed(self, measure: str) -> Estimate:
        found = self.estimates[measure]
        assert found is not None  # every agent has it in every world
        return found

    @property
    def collision_rate(self) -> Estimate:
        """Share of worlds."""
        return self._needed("collision_rate")

    @property
    def first_impact_harm(self) -> Estimate:
        """Each pair's first impact."""
        return self._needed("first_impact_harm")

    @property
    def total_harm(self) -> Estimate:
        """Every impact."""
        return self._needed("total_harm")

    @property
    def metrics(self) -> dict[str, Estimate]:
        """Registered measures, by column."""
        found = {name.removeprefix(COLUMN): each for name, each in self.estimates.items() if name.startswith(COLUMN)}
        return {name: each for name, each in found.items() if each is not None}

    @property
    def sees_through(self) -> bool:
        """Whether the channel hides something here that this agent reads all the same."""
        return self.hidden_share > 0.0 and sees_through(self.knows)

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        of_limits = {measure.name for measure in measures(()) if measure.limits}
        optional = {measure.name for measure in measures(()) if not measure.always}
        told = {name: each for name, each in self.estimates.items() if each or name not in optional}
        return {
            "kind": "evaluate",
            "agent": self.agent,
            "knows": knowledge_text(self.knows),
            "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share,
            "episodes": self.episodes,
            "collisions": self.collisions,
            "horizon_ends": self.horizon_ends,
            **estimates_to_json({name: each for name, each in told.items() if name not in of_limits}),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **estimates_to_json({name: each for name, each in told.items() if name in of_limits}),
            "known_best_share": self.known_best_share,
            "best_known_warning": self.warning or None,
            "below_best_known": self.below_best_known,
            "impact_unproven": None if self.between is None else asdict(self.between),
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": metric_headings(self.metrics)} if self.metrics else {}),
            "parameters": self.parameters,
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
        share = partial(Column, digits=1, scale=100.0, unit=" %")
        columns = (
            "Agent", "Knows", share("Collisions"), Column("First-impact harm"), Column("Total harm"),
            Column("Regret, first"), share("Decrease, first"), share("Realised share, first"),
        )  # fmt: skip
        names = ("collision_rate", "first_impact_harm", "total_harm", "mean_regret_first", "harm_decrease_first")
        rows = [
            (row.agent, knowledge_text(row.knows), *(row[name] for name in (*names, "realised_share_first")))
            for row in self
        ]
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += f" WARNING: {self[0].warning}." if self and self[0].warning else ""
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        return Sheet(worlds, columns, rows, note).html()


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE) -> SummaryTable:
    """One row per agent, in the order of the evaluation; compared with ``baseline`` where that was evaluated."""
    limits, outcomes = evaluation.limits, evaluation.outcomes
    shared = {
        "parameters": parameters(evaluation),
        "between": between_of(evaluation),
        "warning": limits.warning if isinstance(limits, Limits) else "",
        "left_out": evaluation.left_out,
        "beside_paper": is_papers_test(evaluation),
        "hidden_share": float(evaluation.hidden.mean()),
        "worlds_sha256": worlds_sha256(evaluation.worlds, evaluation.index),
        "scenario_sha256": scenario_sha256(evaluation.scenario),
        "versions": result_versions(),
    }
    policies = {name: policies_by_name(each.policies, evaluation.scenario) for name, each in outcomes.items()}
    tallies = tally_agents(evaluation, baseline=baseline)
    knows = {name: outcome.knows for name, outcome in outcomes.items()}
    return summarise_tallies(tallies, evaluation.worlds.n, rate, knows, policies, shared, baseline=baseline)


def summarise_tallies(
    tallies: Mapping[str, AgentTally],
    worlds: int,
    rate: Callable[[int, int], Estimate],
    knows: Mapping[str, Knowledge],
    policies: Mapping[str, Mapping[str, str]],
    shared: Mapping[str, Any],
    *,
    baseline: str = BASELINE,
) -> SummaryTable:
    """One row per agent, from exact sums over so many worlds.

    Args:
        tallies: by agent.
        worlds: their number.
        rate: gives a share of so many worlds, of all, with its interval.
        knows: what each agent says it knows.
        policies: of each agent, by the vehicle's name.
        shared: fields of ``SummaryRow`` that are the same for all.
        baseline: what is compared with.

    """
    return SummaryTable(
        SummaryRow(
            agent=agent,
            episodes=worlds,
            estimates=estimate_all(tallies, agent, worlds, rate, baseline=baseline),
            collisions=tally.count("collision_rate"),
            horizon_ends=tally.count(HORIZON),
            policy_share=tally.share(CHOSEN, worlds),
            known_best_share=tally.share(KNOWN, worlds),
            below_best_known=tally.count(BELOW) if BELOW in tally.counts else None,
            knows=knows[agent],
            policy_sha256=policies[agent],
            **shared,
        )
        for agent, tally in tallies.items()
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


# The table, for a terminal and for a document, and the sentences below it.

SEES_THROUGH = "† "  # before what an agent knows that no channel brought
_NAMED = 10  # worlds left out that are named one by one; all stand in the JSON
_HEAD = {
    "Agent": "What drives the controlled vehicle; all other vehicles follow the scenario. full_brake is the paper's"
    " non-ethical strategy (Non-E). e_v2x_bm is the best constant deceleration found in this simulation;"
    " e_v2x_bm:pairwise is the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent has to know of the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the others' states, capacities and latencies as they are,"
    " received or not. true model: also masses, restitution and scripts, enough to simulate the line ahead. Of a policy"
    " behind a shield, or a refined one, both parts are told. † marks agents that see through a channel that hides"
    " something here.",
}
_ALWAYS_SHOWN = ("collision_rate", "first_impact_harm", "total_harm", "sampled_harm", "vehicle_1_shoved_m")
_NARROW = (  # in a narrow terminal too, where there is no regret to show, and where there is
    ("harm_decrease_first", "harm_decrease_total"),
    ("mean_regret_first", "realised_share_first"),
)
_BELOW = ("collision_rate", "first_impact_harm", "total_harm")  # a terminal shows their intervals; JSON has all


def table_meanings(rows: Sequence[SummaryRow]) -> dict[str, str]:
    """What the columns mean, by the beginning of their headings; those of registered measures last."""
    about = {each.heading.partition(",")[0]: each.about for each in measures(()) if each.about}
    return _HEAD | about | (metric_meanings(rows[0].metrics) if rows else {})


def summary_sheet(rows: Sequence[SummaryRow]) -> Sheet:
    """The table: agent, what it knows, and every measure that has a heading, those of registered ones last.

    Below it the paper's rows, where they are about the same test.
    """
    told = [each for each in measures(()) if each.heading]
    own = metric_headings(rows[0].metrics) if rows else {}
    columns = [each.column() for each in told] + [Column(own[name], COLUMN + name, sign="-") for name in own]
    lines: list[Row] = [
        (
            row.agent,
            SEES_THROUGH * row.sees_through + knowledge_text(row.knows),
            *(_regret(row) if column.name == "mean_regret_first" else row[column.name] for column in columns),
        )
        for row in rows
    ]
    for name, paper in _papers(rows).items():
        lines += [f"paper, {name}", *((agent, None, *(cells.get(c.name) for c in columns)) for agent, cells in paper)]
    return Sheet("", ["Agent", "Knows", *columns], lines)


def _papers(rows: Sequence[SummaryRow]) -> dict[str, list[tuple[str, dict[str, str]]]]:
    """The paper's rows that belong beside these, by table, with the digits that it prints."""
    found: dict[str, list[tuple[str, dict[str, str]]]] = {}
    for row in PAPER_ROWS if rows and rows[0].beside_paper else ():
        cells = {"collision_rate": f"{100 * row.collision_rate:.4g} %", "first_impact_harm": f"{row.average_harm:.6g}"}
        if row.harm_decrease is not None:
            cells["harm_decrease_first"] = f"{100 * row.harm_decrease:.4g} %"
        found.setdefault(row.table, []).append((row.agent, cells))
    return found


def paper_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """The conditions of the paper's rows that stand beside these, by table; the last is what must be known of them."""
    found = [f"{name}: {PAPER_PARAMETERS[name]}." for name in _papers(rows)]
    return [*found, PAPER_NOTE] if found else []


def _regret(row: SummaryRow) -> Shown:
    """The regret, marked as a lower bound where the best of some world is not known beforehand."""
    value, interval = Column("", sign="-").show(row["mean_regret_first"])
    bound = row.known_best_share is not None and row.known_best_share < 1.0
    return Shown(f"≥ {value}" if bound else value, interval)


def rich_table(rows: Sequence[SummaryRow]) -> Sheet:
    """The table for a terminal of 80 columns or more: ours, then the paper's rows, then the conditions of each."""
    sheet, narrow = summary_sheet(rows), (*_ALWAYS_SHOWN, *_NARROW[bool(limit_lines(rows))])
    columns = [
        replace(each, wide=each.name not in narrow, interval="below" if each.name in _BELOW else "hidden")
        for each in (measure.column() for measure in measures(()) if measure.heading)
    ]
    lines = [
        row
        if isinstance(row, str)
        else (row[0] if row[1] is None else f"{row[0]}\n{row[1]}", *row[2 : 2 + len(columns)])
        for row in sheet.rows
    ]
    return Sheet("", [Column("Agent,\nwhat it knows", text=True), *columns], lines, _conditions(rows), gap=1)


def metrics_table(rows: Sequence[SummaryRow]) -> Sheet:
    """The registered measures: one line per agent, the mean per world with its interval."""
    headings = metric_headings(rows[0].metrics) if rows else {}
    lines = [(row.agent, headings[column], value) for row in rows for column, value in row.metrics.items()]
    return Sheet("Measures", ["Agent", Column("Measure", text=True), Column("Mean or rate")], lines)


def markdown_table(rows: Sequence[SummaryRow]) -> str:
    """The table for a document, with the conditions of ours and of the paper's below it."""
    return f"{summary_sheet(rows).markdown()}\n\n{_conditions(rows)}\n"


def _conditions(rows: Sequence[SummaryRow]) -> str:
    if not rows:
        return ""
    texts = [
        f"Ours: {parameter_line(rows[0].parameters)}. Harms are means per world in m²/s²; in brackets or"
        " below a value: its 95 % interval; decreases are relative to full braking."
    ]
    texts += left_out_lines(rows) + warning_lines(rows) + limit_lines(rows) + knowledge_lines(rows)
    *paper, note = paper_lines(rows) or [""]
    return "\n\n".join([*texts, *(f"Paper, {line}" for line in paper), *([note] if note else [])])


def left_out_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """Which worlds no row counts, as a sentence; none where every world counts."""
    left_out = rows[0].left_out if rows else ()
    if not left_out:
        return []
    whole = rows[0].episodes + len(left_out)
    return [left_out_line([str(left) for left in left_out], whole)]


def left_out_line(worlds: Sequence[str], whole: int) -> str:
    """That these of ``whole`` worlds, each named with its reason, count in no figure."""
    named = [*worlds[:_NAMED], *(["and so on"] if len(worlds) > _NAMED else [])]
    return (
        f"LEFT OUT for every agent: {len(worlds):,} of {whole:,} worlds, which the physics could not advance"
        f" (please report them): {'; '.join(named)}."
    )


def warning_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """That a table of best known harm lacks some of these worlds, and where the horizon cut a motion off, as sentences.

    None where all is well.
    """
    lines = [f"WARNING: {rows[0].warning}."] if rows and rows[0].warning else []
    moving = [f"{row.agent} {row.horizon_ends:,}" for row in rows if row.horizon_ends]
    if moving:
        lines.append(
            f"At the horizon ({rows[0].parameters['horizon_s']:g} s) something still moved, and what came after counts"
            f" nowhere; worlds, of {rows[0].episodes:,}: {', '.join(moving)}."
        )
    return lines


def limit_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """What nobody could avoid in these worlds and the best known harm, as sentences; none where nothing is proven."""
    first, total = (rows[0][f"best_known_{name}_harm"] for name in ("first_impact", "total")) if rows else (None, None)
    if first is None or total is None:
        return []
    share = Column("", digits=1, scale=100.0, unit=" %", sign="-")
    contact, impact = (share.show(rows[0][name]).in_words for name in ("unavoidable_rate", "impact_proven_rate"))
    if rows[0]["unavoidable_rate"] is None:
        text = f"In {impact} of these worlds no {_command_of(rows[0])} avoids an impact (proven)."
    else:
        text = f"In {contact} of these worlds no {_command_of(rows[0])} avoids contact"
        text += f", in {impact} none avoids an impact (both proven).{_tell_gap(rows[0].between)}"
    text += _tell_proven(rows[0]["proven_harm"], first.value, total.value)
    known = rows[0].known_best_share
    if known is not None and known < 1.0:
        text += (
            f" Found beforehand in {100 * known:.1f} % of the worlds; in the others it is the best of"
            " the agents above, so that regrets are lower bounds and no realised share is stated."
        )
    below = [f"{row.agent} in {count_of(row.below_best_known, 'world')}" for row in rows if row.below_best_known]
    return [text + (f" Below what was known: {', '.join(below)}." if below else "")]


def _command_of(row: SummaryRow) -> str:
    """Whose command it is: ``command of Vehicle 2``, or ``joint command`` where several are driven."""
    driven = row.parameters.get("controlled_vehicle")
    return "joint command" if driven is None else f"command of {str(driven).replace('vehicle_', 'Vehicle ')}"


def _tell_proven(found: Estimate | None, first: float, total: float) -> str:
    """The best known and the proven harm, and what lies between, as a sentence."""
    proven = 0.0 if found is None else found.value
    return (
        f" Best known harm: {first:.2f} first-impact, {total:.2f} total; proven: no less than {proven:.2f}; gap:"
        f" {first - proven:.2f} ({_share(first - proven, first)}) and {total - proven:.2f}"
        f" ({_share(total - proven, total)})."
    )


def _tell_gap(found: Between | None) -> str:
    """What is known of the worlds with proven contact and no proven impact, as a sentence."""
    if found is None or found.rate == 0.0:
        return ""
    text = f" In the {100 * found.rate:.1f} % between, whether an impact can be avoided is open"
    if found.mean_first is None or found.harmless_rate is None:
        return f"{text}."
    return (
        f"{text}: the best known do {found.mean_first:.2f} there on average, and next to none in"
        f" {100 * found.harmless_rate:.0f} % of them."
    )


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole > 0.0 else DASH


def identity_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """By which hashes this result is recognised, as a sentence; none without rows."""
    if not rows:
        return []
    policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in rows if row.policy_sha256]
    text = f"SHA-256 of the worlds {rows[0].worlds_sha256}, of the scenario {rows[0].scenario_sha256}"
    return [f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."]


def knowledge_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """Who sees through the channel, and who does not say, as sentences; none where the channel hides nothing."""
    hidden = rows[0].hidden_share if rows else 0.0
    if not hidden:
        return []
    text = (
        f"In {100 * hidden:.1f} % of these worlds the channel hides something of the line from a driven vehicle at its"
        " first decision: news that has not arrived, or how late another vehicle will react."
    )
    through = ", ".join(row.agent for row in rows if row.sees_through)
    if through:
        text += (
            f" {SEES_THROUGH.strip()} {through}: drives by the line as it is all the same. That is a limit to compare"
            " with, and nothing that a vehicle on this channel could do."
        )
    silent = ", ".join(row.agent for row in rows if Source.UNSTATED in row.knows)
    return [text + (f" Not stated what it knows: {silent}." if silent else "")]


# An evaluation by group: the worlds of each scenario of a mixture, or those in which a vehicle is of one type.

NO_TYPE = "no type"  # of a vehicle of a mixture's member without types


def summarise_by(evaluation: Evaluation, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """Rows as ``summarise`` for each group of worlds, by the group's name, sorted.

    Args:
        evaluation: of a mixture, or of a scenario with types of vehicles.
        by: ``scenario``, or whose type: ``vehicle_2_type``.
        baseline: as in ``summarise``.

    Raises ``InvalidInput`` for worlds that were drawn without such, ``UnknownName`` for another column.

    >>> import ethbrake_marl as eb
    >>> delays = eb.load_scenario("mixture-delays")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> found = eb.summarise_by(eb.evaluate(delays.sample(30, seed=7), agents, scenario=delays), "scenario")
    >>> {name: rows[0].episodes for name, rows in found.items()}
    {'paper-delay-high': 11, 'paper-delay-low': 8, 'paper-delay-middle': 11}

    """
    return {name: summarise(part, baseline=baseline) for name, part in _groups(evaluation, by)}


def check_group(kinds: Collection[str], by: str) -> None:
    """Raise what ``summarise_by`` would for worlds with these columns of ``Evaluation.kinds``."""
    if not kinds:
        raise InvalidInput(
            f"by {by!r}: these worlds have no groups; those of a mixture have scenario, those with vehicle_types have"
            " vehicle_1_type and so on"
        )
    if by not in kinds:
        raise unknown_name("group", by, kinds)


def _groups(evaluation: Evaluation, by: str) -> Iterator[tuple[str, Evaluation]]:
    check_group(evaluation.kinds, by)
    column = evaluation.kinds[by]
    for name in np.unique(column).tolist():
        yield name or NO_TYPE, evaluation.take(column == name)
