"""Measures that compare an agent with what is possible: proven bounds, best known harm, and regret."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.search.limits import Unproven
from ethbrake_marl.extensions.search.regret import KNOWN_OF_WORLDS, Between, Regrets, limits_of, regrets_of
from ethbrake_marl.files.sheet import DASH, Column
from ethbrake_marl.first_edition.evaluation.agent_tally import AgentTally
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import HELD
from ethbrake_marl.first_edition.evaluation.measure_sets import BASELINE, GroupColumn, Measure, MeasureSet, Silent
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow

NAME = "limits"  # name of the entry point

KNOWN, BELOW = "known", "below_best_known"


class LimitMeasures(MeasureSet):
    """Measures of unavoidable contact, of the best known harm, and of each agent's regret."""

    measures = (
        Measure(
            "unavoidable_rate", lambda _, r: None if r.avoidable is None else ~r.avoidable,
            about="Share of worlds in which contact is proven unavoidable.",
        ),
        Measure(
            "impact_proven_rate", lambda _, r: r.limits.proof.impact,
            about="Share of worlds in which an impact is proven unavoidable.",
        ),
        Measure(
            "avoidable_collision_rate", lambda o, r: None if r.avoidable is None else o.collided & r.avoidable,
            about="Share of worlds in which the agent has a collision although contact is proven avoidable.",
        ),
        Measure(
            "best_known_first_impact_harm", lambda _, r: r.first_impact_harm,
            about="Best known first-impact harm, mean over the worlds.",
        ),
        Measure(
            "best_known_total_harm", lambda _, r: r.total_harm,
            about="Best known total harm, mean over the worlds.",
        ),
        Measure(
            "proven_harm", lambda _, r: r.limits.proof.harm,
            about="Lower bound, mean over the worlds: no commands do less harm (proven).",
        ),
        Measure(
            "best_known_minus_proven_first", lambda _, r: r.above_proven(r.first_impact_harm),
            about="Best known first-impact harm minus the proven lower bound, mean over the worlds.",
        ),
        Measure(
            "best_known_minus_proven_total", lambda _, r: r.above_proven(r.total_harm),
            about="Best known total harm minus the proven lower bound, mean over the worlds.",
        ),
        Measure(
            "mean_regret", "mean_regret_first",
            about="Another name of mean_regret_first.",
        ),
        Measure(
            "mean_regret_first", lambda o, r: r.regret(o, "first"), "Regret, first-impact", "Regret\nfirst",
            "First-impact harm minus the best known first-impact harm of the same world; mean over the worlds. The best"
            " known harm is 0 where contact is proven avoidable. Elsewhere it comes from an earlier search over the"
            " commands of the controlled vehicles, or from an agent in this table that does less harm. The sign ≥ means"
            " that some worlds were not searched earlier.",
        ),
        Measure(
            "mean_regret_total", lambda o, r: r.regret(o, "total"),
            about="Total harm minus the best known total harm of the same world; mean over the worlds.",
        ),
        Measure(
            "share_of_possible_reduction", "mean_regret_first", against="decrease",
            about="Another name of share_of_possible_reduction_first.",
        ),
        Measure(
            "share_of_possible_reduction_first", "mean_regret_first", "Share of the possible reduction, first-impact",
            "Share of\npossible",
            "(Full braking − agent) / (full braking − best known harm), computed from the means of first-impact harm:"
            " 0 % is full braking, 100 % the best known harm.",
            percent=True, against="decrease",
        ),
        Measure(
            "share_of_possible_reduction_total", "mean_regret_total", against="decrease",
            about="(Full braking − agent) / (full braking − best known harm), computed from the means of total harm.",
        ),
    )  # fmt: skip
    counted = (Measure(KNOWN, lambda _, r: r.limits.known), Measure(BELOW, lambda o, r: r.below(o)))
    baseline = BASELINE
    whole = KNOWN
    narrow = ("mean_regret_first", "share_of_possible_reduction_first")
    notebook = narrow
    group_column = GroupColumn(
        Column(
            "Share of the possible reduction", "share_of_possible_reduction", digits=1, scale=100.0, unit=" %",
            short="Share of\npossible", interval="hidden",
        ),
        {"first": "share_of_possible_reduction_first", "total": "share_of_possible_reduction_total"},
        "Share of the possible reduction of {harm} harm: 0 % for full braking, 100 % for the best known harm. The cell"
        " is empty if the best known harm of some world is missing.",
    )  # fmt: skip
    per_world = KNOWN_OF_WORLDS
    texts = frozenset({"unavoidable_reason", "best_known_source"})
    because_key = "no_limits_because"
    not_in_long_lists = f"proofs and regrets are computed for lists of at most {HELD:,} worlds"

    def prepare(self, evaluation: Evaluation) -> Regrets | Silent:
        """Return the best known harm of every world; if the proofs do not apply, return ``Silent`` with the reason."""
        limits, regrets = limits_of(evaluation), regrets_of(evaluation)
        if isinstance(limits, Unproven):
            return Silent(limits.because)
        assert regrets is not None
        return regrets

    def row(self, tally: AgentTally, worlds: int, context: Regrets | Silent) -> dict[str, Any]:
        """Return additional values for the summary of an agent, as a dictionary from the name to the value.

        ``known_best_share`` is the share of the worlds for which a best known harm existed before the evaluation.
        ``below_best_known`` is the number of worlds in which the agent does less harm than the best harm known before
        the evaluation. ``best_known_warning`` is the text ``Limits.warning``; None if there is no warning.
        ``impact_unproven`` describes the worlds in which contact is proven unavoidable, but an impact is not proven
        unavoidable, with the fields of ``Between``.
        """
        between = None if isinstance(context, Silent) else context.between
        return {
            "known_best_share": tally.share(KNOWN, worlds),
            "best_known_warning": None if isinstance(context, Silent) else context.limits.warning or None,
            "below_best_known": tally.count(BELOW) if BELOW in tally.counts else None,
            "impact_unproven": None if between is None else asdict(between),
        }

    def warnings(self, rows: Sequence[SummaryRow]) -> Sequence[str]:
        """Return the text ``Limits.warning`` as a list; an empty list if there is no warning."""
        warning = rows[0].more[NAME]["best_known_warning"]
        return [warning] if warning else []

    def notes(self, rows: Sequence[SummaryRow]) -> Sequence[str]:
        """Return a list with one note about unavoidable harm and the best known harm; empty if nothing is proven."""
        row, first, total = rows[0], rows[0]["best_known_first_impact_harm"], rows[0]["best_known_total_harm"]
        if first is None or total is None:
            return []
        lines = [line for line in (_unavoidable(row), _best(row, first.value, total.value)) if line]
        known = row.more[NAME]["known_best_share"]
        if known is not None and known < 1.0:
            lines.append(
                f"An earlier search covers {100.0 * known:.1f} % of the worlds. Elsewhere the best known harm is only"
                " the least harm of the agents above, so regrets are lower bounds, and the share of the possible"
                " reduction is omitted."
            )
        counts = {each.agent: each.more[NAME]["below_best_known"] for each in rows}
        below = [f"{agent} in {count_of(count, 'world')}" for agent, count in counts.items() if count]
        lines += [f"Less harm than the earlier best known harm: {', '.join(below)}."] if below else []
        return [" ".join(lines)]


def best_known_words(row: SummaryRow) -> str:
    """Return "best known", or "best of these agents" if some worlds were not searched before the evaluation."""
    share = row.more[NAME]["known_best_share"]
    return "best known" if share is None or share == 1.0 else "best of these agents"


def _unavoidable(row: SummaryRow) -> str:
    """Return sentences about the shares of worlds in which contact, or an impact, is proven unavoidable."""
    vehicle = row.parameters.get("controlled_vehicle")
    command = f"command of {str(vehicle).replace('vehicle_', 'Vehicle ')}" if vehicle else "joint command"
    share = Column("", digits=1, scale=100.0, unit=" %")
    contact, impact = (share.show(row[name]).in_words for name in ("unavoidable_rate", "impact_proven_rate"))
    if row["unavoidable_rate"] is None:
        return ""
    if row["impact_proven_rate"] is None:
        return f"In {contact} of the worlds, no {command} avoids contact (proven)."
    between = row.more[NAME]["impact_unproven"]
    text = f"In {contact} of the worlds, no {command} avoids contact; in {impact}, none avoids an impact (both proven)."
    return text + ("" if between is None else Between(**between).text)


def _best(row: SummaryRow, first: float, total: float) -> str:
    """Return a sentence with the best known harm, the proven bound, and the difference between them.

    ``first`` and ``total`` are the means of the best known first-impact and total harm, m2/s2.
    """
    text = f"Mean best known harm: {first:.2f} first-impact, {total:.2f} total."
    if row["proven_harm"] is None:
        return text
    least = row["proven_harm"].value
    gaps = [
        f"{best - least:.2f} ({f'{100 * (best - least) / best:.1f} %' if best > 0.0 else DASH})"
        for best in (first, total)
    ]
    return (
        f"{text} Proven lower bound: {least:.2f}. Best known harm minus this bound: {gaps[0]} first-impact,"
        f" {gaps[1]} total."
    )


LIMITS = LimitMeasures()
