"""Measures of the distance to the best: proven bounds, best known harm, and the regret of each agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.agent_tally import AgentTally
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import HELD
from ethbrake_marl.evaluation.measure_sets import BASELINE, GroupColumn, Measure, MeasureSet, Silent
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.extensions.search.limits import Unproven
from ethbrake_marl.extensions.search.regret import KNOWN_OF_WORLDS, Between, Regrets, limits_of, regrets_of
from ethbrake_marl.files.sheet import DASH, Column

NAME = "limits"  # name of the entry point

KNOWN, BELOW = "known", "below_best_known"


class LimitMeasures(MeasureSet):
    """Measures of unavoidable contact, best known harm, and each agent's distance from it.

    Their context is a ``Regrets`` object: the best known harm of every world.
    """

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
            about="Share of worlds with a collision, though contact is proven avoidable.",
        ),
        Measure(
            "best_known_first_impact_harm", lambda _, r: r.first_impact_harm,
            about="The least first-impact harm known of the same worlds.",
        ),
        Measure(
            "best_known_total_harm", lambda _, r: r.total_harm,
            about="The same of total harm.",
        ),
        Measure(
            "proven_harm", lambda _, r: r.limits.proof.harm,
            about="Proven: nobody can do less.",
        ),
        Measure(
            "best_known_minus_proven_first", lambda _, r: r.first_impact_harm - r.limits.proof.harm,
            about="What is left between the best known and the proof.",
        ),
        Measure(
            "best_known_minus_proven_total", lambda _, r: r.total_harm - r.limits.proof.harm,
            about="The same of total harm.",
        ),
        Measure(
            "mean_regret", "mean_regret_first",
            about="The same as mean_regret_first.",
        ),
        Measure(
            "mean_regret_first", lambda o, r: r.regret(o, "first"), "Regret, first-impact", "Regret\nfirst",
            "First-impact harm minus the best known first-impact harm of the same world; mean per world. The best known"
            " is 0 where contact is proven avoidable, else the result of an earlier search over whole profiles of the"
            " controlled vehicles, or of an agent in this table that did better. With ≥: the best of some world is"
            " known from these agents alone.",
        ),
        Measure(
            "mean_regret_total", lambda o, r: r.regret(o, "total"),
            about="The same of total harm.",
        ),
        Measure(
            "share_of_possible_reduction", "mean_regret_first", against="decrease",
            about="The same as share_of_possible_reduction_first.",
        ),
        Measure(
            "share_of_possible_reduction_first", "mean_regret_first", "Share of the possible reduction, first-impact",
            "Share of\npossible",
            "(Full braking − agent) / (full braking − best known), first-impact harm: how much of the reduction of harm"
            " that is known to be possible the agent brings.",
            percent=True, against="decrease",
        ),
        Measure(
            "share_of_possible_reduction_total", "mean_regret_total", against="decrease",
            about="The same of total harm.",
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
        "Share of the possible reduction of {harm} harm: 0 % for full braking, 100 % for the best known harm; none"
        " where that is not known of every world.",
    )  # fmt: skip
    per_world = KNOWN_OF_WORLDS
    texts = frozenset({"unavoidable_reason", "best_known_source"})
    because_key = "no_limits_because"
    not_in_long_lists = f"a list of more than {HELD:,} worlds is driven without proofs"

    def prepare(self, evaluation: Evaluation) -> Regrets | Silent:
        """Return the best known harm of every world, or ``Silent`` with the reason if nothing is proven."""
        limits, regrets = limits_of(evaluation), regrets_of(evaluation)
        if isinstance(limits, Unproven):
            return Silent(limits.because)
        assert regrets is not None
        return regrets

    def row(self, tally: AgentTally, worlds: int, context: Regrets | Silent) -> dict[str, Any]:
        """Return further values of one agent's row, by name.

        ``known_best_share`` is the share of worlds with a best known harm, ``below_best_known`` the number of worlds
        where the agent is below it, ``best_known_warning`` a warning or None, and ``impact_unproven`` the summary of
        worlds with proven contact but no proven impact (``Between``).

        Args:
            tally: counts and means of the agent.
            worlds: number of worlds.
            context: result of ``prepare``.

        """
        between = None if isinstance(context, Silent) else context.between
        return {
            "known_best_share": tally.share(KNOWN, worlds),
            "best_known_warning": None if isinstance(context, Silent) else context.limits.warning or None,
            "below_best_known": tally.count(BELOW) if BELOW in tally.counts else None,
            "impact_unproven": None if between is None else asdict(between),
        }

    def warnings(self, rows: Sequence[SummaryRow]) -> Sequence[str]:
        """Return the warning that a table of best known harm covers only some of the worlds, as a list; empty if there
        is none.

        ``rows`` are the summaries of the agents.
        """
        warning = rows[0].more[NAME]["best_known_warning"]
        return [warning] if warning else []

    def notes(self, rows: Sequence[SummaryRow]) -> Sequence[str]:
        """Return a note on unavoidable harm and the best known harm, as a list; empty if nothing is proven.

        ``rows`` are the summaries of the agents.
        """
        row, first, total = rows[0], rows[0]["best_known_first_impact_harm"], rows[0]["best_known_total_harm"]
        if first is None or total is None:
            return []
        lines = [_unavoidable(row), _best(row, first.value, total.value)]
        known = row.more[NAME]["known_best_share"]
        if known is not None and known < 1.0:
            lines.append(
                f"Found beforehand in {100.0 * known:.1f} % of the worlds; in the others it is the best of the agents"
                " above, so that regrets are lower bounds and no share of the possible reduction is stated."
            )
        counts = {each.agent: each.more[NAME]["below_best_known"] for each in rows}
        below = [f"{agent} in {count_of(count, 'world')}" for agent, count in counts.items() if count]
        lines += [f"Less harm than the best known before: {', '.join(below)}."] if below else []
        return [" ".join(lines)]


def best_known_words(row: SummaryRow) -> str:
    """Return the name of the best known harm: another one where some world was not searched beforehand."""
    share = row.more[NAME]["known_best_share"]
    return "best known" if share is None or share == 1.0 else "best of these agents"


def _unavoidable(row: SummaryRow) -> str:
    """Return a sentence on the shares of worlds with proven contact and proven impact, and on the worlds between the
    two.
    """
    vehicle = row.parameters.get("controlled_vehicle")
    command = f"command of {str(vehicle).replace('vehicle_', 'Vehicle ')}" if vehicle else "joint command"
    share = Column("", digits=1, scale=100.0, unit=" %")
    contact, impact = (share.show(row[name]).in_words for name in ("unavoidable_rate", "impact_proven_rate"))
    if row["unavoidable_rate"] is None:
        return f"In {impact} of these worlds no {command} avoids an impact (proven)."
    between = row.more[NAME]["impact_unproven"]
    text = f"In {contact} of these worlds no {command} avoids contact, in {impact} none avoids an impact (both proven)."
    return text + ("" if between is None else Between(**between).text)


def _best(row: SummaryRow, first: float, total: float) -> str:
    """Return a sentence on the best known harm (``first`` and ``total``, mean in m2/s2), the proven bound, and their
    gap.
    """
    least = 0.0 if row["proven_harm"] is None else row["proven_harm"].value
    gaps = [
        f"{best - least:.2f} ({f'{100 * (best - least) / best:.1f} %' if best > 0.0 else DASH})"
        for best in (first, total)
    ]
    return (
        f"Best known harm: {first:.2f} first-impact, {total:.2f} total; proven: no less than {least:.2f};"
        f" gap: {' and '.join(gaps)}."
    )


LIMITS = LimitMeasures()
