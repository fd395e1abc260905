"""Compare our results with the paper's tables: which numbers agree, which differ, and which no strategy can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

from ethbrake_marl.extensions.report.paper_rows import PaperRow
from ethbrake_marl.extensions.reproduction.folder import Made, Parameter, csv_text
from ethbrake_marl.extensions.reproduction.strategies import ABOUT_BASELINE, FULL_BRAKE, NAMES, PAIRWISE, harms
from ethbrake_marl.extensions.reproduction.verdicts import HARM, PERCENT, PREDICTED, PROVEN, Verdict, compare_number
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.statistics import mean, rate, relative_decrease
from ethbrake_marl.first_edition.physics.state import Bools

_RATE, _MEAN_HARM, _DECREASE, _TOTAL = "collision rate", "average harm", "harm decrease", "total harm"

_PREDICTED_HARM = "predicted harm"

_PRINTED: Mapping[str, Column] = {_RATE: PERCENT, _MEAN_HARM: HARM, _DECREASE: PERCENT}

NOBODY = "least possible (proven)"

_UNDERCUT = {_RATE: "worlds in which no command avoids an impact", _MEAN_HARM: "harm that no command undercuts"}


def collision_rate(collided: Bools) -> Estimate:
    """Return the share of worlds with an impact (mask ``collided``, [n]), with its 95 % interval."""
    return rate(int(collided.sum()), len(collided))


@dataclass(frozen=True)
class Beside:
    """Our results to compare with a table of the paper, under one assumption on when Vehicle 2 may act."""

    title: str  # description of the assumption
    evaluation: Evaluation  # outcomes of our strategies
    # strategy in the paper -> strategies of ours that it may mean; the paper's number is compared with the first
    ours: Mapping[str, Sequence[str]]

    @cached_property
    def numbers(self) -> dict[str, dict[str, Estimate]]:
        """Our results: strategy -> quantity (such as "collision rate") -> estimate.

        Proven lower bounds for all strategies have the key ``NOBODY``.
        """
        numbers, braking = {}, self.evaluation.outcomes.get(NAMES[FULL_BRAKE])
        for name, outcome in self.evaluation.outcomes.items():
            harm, predicted = outcome.first_impact_harm, outcome.predicted_harm
            own = {
                _RATE: collision_rate(outcome.collided),
                _MEAN_HARM: mean(harm),
                _DECREASE: None if braking is None else relative_decrease(harm, braking.first_impact_harm),
                _TOTAL: mean(outcome.total_harm),
                _PREDICTED_HARM: None if predicted is None else mean(predicted),
            }
            numbers[name] = {quantity: estimate for quantity, estimate in own.items() if estimate is not None}
        least = harms(self.evaluation).get(PROVEN)
        if least is not None:
            numbers[NOBODY] = {_RATE: collision_rate(least > 0.0), _MEAN_HARM: mean(least), _TOTAL: mean(least)}
        return numbers

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Yield our results that may correspond to a printed number, each as (name, estimate).

        ``row`` is the paper's name of the strategy, and ``quantity`` is "collision rate", "average harm" or "harm
        decrease". The printed number is compared with the first result; if the two differ, the verdict also names the
        nearest result.
        """
        for name in self.ours[row]:
            if quantity in self.numbers[name]:
                yield f"{name} ({self.title})", self.numbers[name][quantity]
            if quantity == _MEAN_HARM and name == NAMES[PAIRWISE] and _PREDICTED_HARM in self.numbers[name]:
                yield f"{PREDICTED} ({self.title})", self.numbers[name][_PREDICTED_HARM]
        if quantity == _MEAN_HARM:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", self.numbers[name][_TOTAL]


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """Compare each number in a table of the paper with our results under each assumption."""
    verdicts = []
    for beside in besides:
        least = beside.numbers.get(NOBODY, {})
        for row in printed:
            numbers = {_RATE: row.collision_rate, _MEAN_HARM: row.average_harm, _DECREASE: row.harm_decrease}
            for quantity, number in numbers.items():
                if not number:  # 0: decrease of the baseline itself; None: the paper prints no number
                    continue
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = [other.candidates(row.agent, quantity) for other in besides if other is not beside]
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=_PRINTED[quantity],
                        least=(_UNDERCUT[quantity], least[quantity]) if quantity in least else None,
                        others=dict([*own, *chain(*others)]),
                    )
                )
    return verdicts


def selection_verdict(one: PaperRow, other: PaperRow, chosen: PaperRow) -> Verdict:
    """Return a verdict on the printed number of collisions of the hybrid ``chosen``.

    In each world the hybrid chooses between the strategies ``one`` and ``other``, so it avoids a collision only in
    worlds in which at least one of them does. Therefore it cannot avoid more collisions than the two together.
    """
    avoided = [row.episodes - row.collisions for row in (one, other, chosen)]
    together = avoided[0] + avoided[1]
    text = (
        f"{chosen.agent} is one of the two in every world, so it avoids at most {avoided[0]:,} + {avoided[1]:,} ="
        f" {together:,} collisions; printed: {avoided[2]:,}"
    )
    what = f"{chosen.agent} avoids no more than {one.agent} and {other.agent} together (arithmetic of the printed rows)"
    return Verdict(what, "agrees" if avoided[2] <= together else "cannot agree", text)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Return a verdict on whether the decrease of harm that the paper prints follows from the printed mean harms.

    The decrease is relative to ``baseline``. The verdict is "agrees" if the printed and the computed decrease differ by
    less than 0.01 percentage points.
    """
    follows = 1.0 - row.average_harm / baseline.average_harm
    printed = row.harm_decrease or 0.0
    text = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, "agrees" if abs(follows - printed) < 0.0001 else "cannot agree", text)


def rows_table(beside: Beside) -> Sheet:
    """Return a table of our results under one assumption on when Vehicle 2 may act, with the proven lower bounds."""
    columns: dict[str, Column | str] = {
        _RATE: PERCENT, _MEAN_HARM: "First-impact harm", _TOTAL: "Total harm", _PREDICTED_HARM: "Predicted harm",
        _DECREASE: replace(PERCENT, heading="Harm decrease"),
    }  # fmt: skip
    if not any(_DECREASE in numbers for numbers in beside.numbers.values()):
        del columns[_DECREASE]
    rows = [(name, *map(numbers.get, columns)) for name, numbers in beside.numbers.items()]
    note = f"{beside.evaluation.worlds.n:,} worlds; 95 % intervals; harm in m²/s². {ABOUT_BASELINE}"
    return Sheet(beside.title, ("Strategy", *columns.values()), rows, note)


def beside_printed(
    stem: str,
    printed: Sequence[PaperRow],
    besides: Sequence[Beside],
    arithmetic: Sequence[Verdict],
    parameters: Sequence[Parameter],
    notes: Sequence[str] = (),
) -> Made:
    """Compare a table of the paper with our results, and return verdicts, tables and data.

    ``stem`` is the name of the CSV file, without ending. ``arithmetic`` are verdicts on whether the paper's printed
    numbers are consistent, which need none of our results. ``parameters`` are quantities that affect our results.
    ``notes`` say what was run and what was not.
    """
    columns: dict[str, list[str]] = {
        "Strategy": [row.agent for row in printed],
        "Collisions": [f"{row.collisions:,}" for row in printed],
        "Rate": [f"{100.0 * row.collision_rate:g} %" for row in printed],
        "Average harm": [f"{row.average_harm:g}" for row in printed],
    }
    if any(row.harm_decrease for row in printed):
        columns["Decrease"] = [f"{100.0 * (row.harm_decrease or 0.0):g} %" for row in printed]
    data = [
        (beside.title, name, quantity, beside.evaluation.worlds.n, numbers[quantity])
        for beside in besides
        for name, numbers in beside.numbers.items()
        for quantity in _PRINTED
        if quantity in numbers
    ]
    csv = csv_text(("reading", "strategy", "quantity", "worlds", "value", "low", "high"), data)
    tables = [
        Sheet("The paper's rows, as printed", [*columns], [*zip(*columns.values(), strict=True)]),
        *map(rows_table, besides),
    ]
    return Made([*arithmetic, *compare_rows(printed, besides)], parameters, tables, data={stem: csv}, notes=notes)
