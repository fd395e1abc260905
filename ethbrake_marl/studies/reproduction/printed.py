"""Our rows beside those of the paper's tables: what agrees, what differs, and what no strategy can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from ethbrake_marl.evaluation import Evaluation
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.paper import PaperRow
from ethbrake_marl.evaluation.statistics import Estimate, mean, rate, relative_decrease
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.studies.reproduction.item import Table, csv_text
from ethbrake_marl.studies.reproduction.measure import (
    ABOUT_BASELINE,
    FULL_BRAKE,
    NAMES,
    PREDICTED,
    collision_rate,
    proven_harm,
)
from ethbrake_marl.studies.reproduction.verdicts import (
    AGREES,
    CANNOT,
    HARM,
    PERCENT,
    Bound,
    Show,
    Verdict,
    compare_number,
)

RATE, MEAN_HARM, DECREASE = "collision rate", "average harm", "harm decrease"
_SHOWS: Mapping[str, Show] = {RATE: PERCENT, MEAN_HARM: HARM, DECREASE: PERCENT}
NOBODY = "least possible (proven)"


@dataclass(frozen=True)
class Beside:
    """Our results in one reading, to stand beside the paper's rows."""

    title: str
    evaluation: Evaluation
    ours: Mapping[str, Sequence[str]]  # the paper's row -> our strategies, the first is the one compared

    @cached_property
    def numbers(self) -> dict[str, dict[str, Estimate]]:
        """Every quantity of every strategy."""
        return {name: self._numbers(outcome) for name, outcome in self.evaluation.outcomes.items()}

    def _numbers(self, outcome: Outcome) -> dict[str, Estimate]:
        found = {RATE: collision_rate(outcome.collided), MEAN_HARM: mean(outcome.first_impact_harm)}
        braking = self.evaluation.outcomes.get(NAMES[FULL_BRAKE])
        if braking is not None:
            decrease = relative_decrease(outcome.first_impact_harm, braking.first_impact_harm)
            found |= {} if decrease is None else {DECREASE: decrease}
        return found

    @cached_property
    def bounds(self) -> dict[str, Bound]:
        """What no strategy undercuts in these worlds."""
        limits, harm = self.evaluation.limits, proven_harm(self.evaluation)
        if isinstance(limits, Unproven) or harm is None:
            return {}
        impact = rate(int((harm > 0.0).sum()), len(harm))
        return {
            RATE: Bound("worlds in which no command avoids an impact", impact),
            MEAN_HARM: Bound("harm that no command undercuts", mean(harm)),
        }

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Everything of ours that may be meant by a number of a row, the compared one first."""
        for name in self.ours[row]:
            if quantity in self.numbers[name]:
                yield f"{name} ({self.title})", self.numbers[name][quantity]
            predicted = self.evaluation.outcomes[name].predicted_harm
            if quantity == MEAN_HARM and predicted is not None and name == NAMES["e_v2x_bm:pairwise"]:
                yield f"{PREDICTED} ({self.title})", mean(predicted)
        if quantity == MEAN_HARM:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", mean(self.evaluation.outcomes[name].total_harm)


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """One verdict per reading, row and quantity."""
    verdicts = []
    for beside in besides:
        for row in printed:
            numbers = {RATE: row.collision_rate, MEAN_HARM: row.average_harm}
            if row.harm_decrease:
                numbers[DECREASE] = row.harm_decrease
            for quantity, number in numbers.items():
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = dict(own)
                for other in besides:
                    others |= dict(other.candidates(row.agent, quantity)) if other is not beside else {}
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=_SHOWS[quantity],
                        bound=beside.bounds.get(quantity),
                        others=others,
                    )
                )
    return verdicts


def selection_verdict(one: PaperRow, other: PaperRow, chosen: PaperRow) -> Verdict:
    """Whether a choice between two strategies, world by world, can avoid as many collisions as is printed.

    It avoids a collision only where one of the two does: at most as many as both together.
    """
    avoided = [row.episodes - row.collisions for row in (one, other, chosen)]
    together = avoided[0] + avoided[1]
    told = (
        f"{chosen.agent} is one of the two in every world, so it avoids at most {avoided[0]:,} + {avoided[1]:,} ="
        f" {together:,} collisions; printed: {avoided[2]:,}"
    )
    what = f"{chosen.agent} avoids no more than {one.agent} and {other.agent} together (arithmetic of the printed rows)"
    return Verdict(what, AGREES if avoided[2] <= together else CANNOT, told)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Whether a printed harm decrease follows from the printed harms, to the printed digits."""
    follows = 1.0 - row.average_harm / baseline.average_harm
    printed = row.harm_decrease or 0.0
    told = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, AGREES if abs(follows - printed) < 0.0001 else CANNOT, told)


def rows_table(beside: Beside) -> Table:
    """Our rows of one reading, with what no strategy undercuts."""
    head = ["Strategy", "Collision rate", "First-impact harm", "Total harm", "Predicted harm"]
    with_decrease = any(DECREASE in numbers for numbers in beside.numbers.values())
    rows = []
    for name, numbers in beside.numbers.items():
        outcome = beside.evaluation.outcomes[name]
        predicted = "–" if outcome.predicted_harm is None else HARM.estimate(mean(outcome.predicted_harm))
        row = [name, PERCENT.estimate(numbers[RATE]), HARM.estimate(numbers[MEAN_HARM])]
        row += [HARM.estimate(mean(outcome.total_harm)), predicted]
        rows.append((*row, *([PERCENT.estimate(numbers[DECREASE])] if with_decrease else [])))
    if beside.bounds:
        least = (PERCENT.estimate(beside.bounds[RATE].least), HARM.estimate(beside.bounds[MEAN_HARM].least))
        rows.append((NOBODY, *least, least[1], "–", *(["–"] if with_decrease else [])))
    count = beside.evaluation.worlds.n
    note = f"{count:,} worlds; 95 % intervals; harm in m²/s². {ABOUT_BASELINE}"
    return Table(beside.title, tuple(head + ["Harm decrease"] * with_decrease), tuple(rows), note)


def rows_csv(besides: Sequence[Beside]) -> str:
    """One row per reading, strategy and quantity."""
    rows: list[list[object]] = []
    for beside in besides:
        found = dict(beside.numbers)
        found |= {NOBODY: {name: bound.least for name, bound in beside.bounds.items()}} if beside.bounds else {}
        for name, numbers in found.items():
            for quantity, estimate in numbers.items():
                low, high = estimate.interval or ("", "")
                rows.append([beside.title, name, quantity, beside.evaluation.worlds.n, estimate.value, low, high])
    return csv_text(("reading", "strategy", "quantity", "worlds", "value", "low", "high"), rows)
