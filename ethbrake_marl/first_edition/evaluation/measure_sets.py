"""Measures of an agent, and sets of measures: the base class, the registry, and the set of the core package.

A measure computes one value per world from an agent's outcome. Measures that need the same information about the worlds
form a set. Extensions add sets by declaring entry points of the group ``ethbrake_marl.first_edition.measure_sets``. Results tables,
JSON results and files with one row per world show the measures of every installed set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.sheet import Column
from ethbrake_marl.first_edition.evaluation.exploits import FAR_M
from ethbrake_marl.first_edition.evaluation.outcome import COLUMN, Outcome, Values
from ethbrake_marl.first_edition.evaluation.own_measures import heading_of
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.registry import Registry

BASELINE = "full_brake"


@dataclass(frozen=True, slots=True)
class Measure:
    """One measure of an agent. Tables show its mean over the worlds or, for a true/false measure, the share of worlds
    in which it is true.

    The field ``of`` is a function of the agent's outcome and of the context that ``MeasureSet.prepare`` returned. The
    function returns one value per world, [n], or None if the measure is not defined for this outcome. If the measure
    compares the agent with the baseline, ``of`` is instead the name of the measure to compare, and ``against`` says how
    to compare.
    """

    name: str  # key in JSON results, different for all measures
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # heading of the measure's column in tables; "": no column
    short: str = ""  # short heading for terminals, possibly with line breaks
    about: str = ""  # explanation for users; "": another measure whose heading begins with the same words has it
    percent: bool = False  # whether tables show percent
    # Comparison with the baseline, paired by world: none, mean difference, or relative decrease of the mean.
    against: Literal["", "difference", "decrease"] = ""
    always: bool = True  # whether JSON shows null for a missing value, instead of omitting the key

    def values(self, outcome: Outcome, context: Any) -> Values | None:
        """Return this measure's value in every world of an outcome, [n].

        The result is None if the measure is a comparison with the baseline, if its set does not apply (context
        ``Silent``), or if the measure is not defined for this outcome.
        """
        if isinstance(self.of, str) or isinstance(context, Silent):
            return None
        return self.of(outcome, context)

    def column(self) -> Column:
        """Return this measure's column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Silent:
    """Context of a set of measures that does not apply to an evaluation. The measures of such a set have no values."""

    because: str  # why the set does not apply: a clause for users, without capital and full stop


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """Column that a set of measures adds to the table of ``ethbrake evaluate`` for a group of scenarios."""

    column: Column
    measures: Mapping[HarmCount, str]  # count of harm that the agents minimise -> name of the measure to show
    note: str  # sentence below the table; ``{harm}`` in it is replaced by ``first-impact`` or ``total``


class MeasureSet:
    """Base class of a set of measures that need the same information about the worlds, the *context*.

    A subclass must list its measures in ``measures``. It may override ``prepare``, which computes the context once per
    evaluation; ``row``, which adds fields to JSON results; and ``warnings`` and ``notes``, which get the rows of a
    results table (``SummaryRow``, one per agent) and add texts to this table.
    """

    measures: tuple[Measure, ...] = ()  # measures with a column or a JSON key, in the order of JSON
    counted: tuple[Measure, ...] = ()  # true/false measures without a column; ``row`` can read how often each is true
    baseline: str | None = None  # name of the agent to compare with; None: the baseline of ``summarise``
    # Name of a measure in ``counted`` that says whether a world's values are complete. If it is false in some world,
    # means are marked "≥" and comparisons are omitted. None: all values are complete.
    whole: str | None = None
    narrow: tuple[str, ...] = ()  # names of measures that even a narrow terminal shows, if they have values
    notebook: tuple[str, ...] = ()  # names of measures that a notebook shows
    group_column: GroupColumn | None = None  # column in the table of a group of scenarios; None: no column
    # Additional columns of files with one row per world, by name. The function takes outcome and context, and returns
    # values [n], or None if there are none.
    per_world: Mapping[str, Callable[[Outcome, Any], Values | None]] = {}
    texts: frozenset[str] = frozenset()  # names of the ``per_world`` columns that contain texts
    because_key: str | None = None  # key in a result's conditions for the reason why the set does not apply
    not_in_long_lists: str = ""  # why the set does not apply to more than 100,000 worlds; "": the set applies

    def prepare(self, evaluation: Any) -> Any:
        """Return the context of an ``Evaluation``, or ``Silent`` with a reason if the set does not apply to it.

        ``Measure.of`` gets the context as its second argument. In the base class it is None.
        """
        return None

    def row(self, tally: Any, worlds: int, context: Any) -> dict[str, Any]:
        """Return fields that this set adds to an agent's object in the JSON results (in the base class: none).

        The returned dictionary must have the same keys in every evaluation, even if the set does not apply.

        Args:
            tally: sums of the agent's measures (``AgentTally``).
            worlds: number of worlds in the evaluation.
            context: result of ``prepare``; None if there are more than 100,000 worlds.

        """
        return {}

    def warnings(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return warnings about a results table: clauses without capital and full stop (in the base class: none)."""
        return ()

    def notes(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return notes to print below a results table: whole sentences (in the base class: none)."""
        return ()


class EpisodeMeasures(MeasureSet):
    """Measures of the core package: collisions, harm, shoving, comparisons with the baseline, and predicted harm."""

    measures = (
        Measure(
            "collision_rate", lambda o, _: o.collided, "Collisions", percent=True,
            about="Share of worlds with at least one impact, with Wilson's interval. Every agent drives the same worlds"
            " once.",
        ),
        Measure(
            "first_impact_harm", lambda o, _: o.first_impact_harm, "First-impact harm", "First-impact\nharm",
            "Squared closing speed of each pair's first impact (m²/s²), summed over the pairs; mean per world. The"
            " paper counts harm in this way.",
        ),
        Measure(
            "total_harm", lambda o, _: o.total_harm, "Total harm", "Total\nharm",
            "Squared closing speed of every impact (m²/s²), summed; mean per world. After a light first impact,"
            " first-impact harm does not count a hard second impact of the same pair; total harm does.",
        ),
        Measure(
            "sampled_harm", lambda o, _: o.sampled_harm, "Sampled harm", "Sampled\nharm",
            "Harm as a sum over time samples (the paper's eq. Jharm). The agent's commands are applied again in the"
            " paper's equations of motion with a fixed step. At every sample, each pair that overlaps and still closes"
            " adds its squared closing speed (m²/s²). Pushing therefore adds harm for as long as it lasts.",
        ),
        Measure(
            "vehicle_1_shoved_m", lambda o, _: o.shoved_m, "Vehicle 1 shoved (m)", "Shoved\nm",
            "How far Vehicle 1 ends beyond the place where it would stop by itself: mean per world, and share of worlds"
            " with more than 5 m. First-impact and total harm do not count pushing. In reality Vehicle 1 brakes for"
            " something, so pushing is dangerous.",
        ),
        Measure(
            "vehicle_1_shoved_far_rate", lambda o, _: None if o.shoved_m is None else o.shoved_m > FAR_M,
            "Vehicle 1 shoved > 5 m", "Shoved\n> 5 m", percent=True,
        ),
        Measure(
            "first_impact_harm_difference", "first_impact_harm", against="difference",
            about="First-impact harm minus that of full braking, paired by world.",
        ),
        Measure(
            "total_harm_difference", "total_harm", against="difference",
            about="Total harm minus that of full braking, paired by world.",
        ),
        Measure(
            "harm_decrease_first", "first_impact_harm", "Decrease, first-impact", "Decrease\nfirst",
            "1 − (mean harm) / (mean harm of full braking in the same worlds), with an interval by the delta method.",
            percent=True, against="decrease",
        ),
        Measure(
            "harm_decrease_total", "total_harm", "Decrease, total", "Decrease\ntotal", percent=True, against="decrease"
        ),
        Measure(
            "predicted_harm",
            lambda o, _: (
                None if o.predicted_harm is None or not np.isfinite(o.predicted_harm).all() else o.predicted_harm
            ),
            "Predicted harm", "Pre-\ndicted",
            "Harm that the agent predicted at the alert, in the count that it minimises.", always=False,
        ),
    )  # fmt: skip
    counted = (Measure("horizon_ends", lambda o, _: ~o.at_rest), Measure("policy_share", lambda o, _: o.chosen_policy))
    narrow = ("harm_decrease_first", "harm_decrease_total")
    notebook = ("collision_rate", "first_impact_harm", "total_harm", "harm_decrease_first")


class RegisteredMeasures(MeasureSet):
    """Measures that the user registered with ``register_measure``; ``columns`` are the keys of ``Outcome.metrics``."""

    def __init__(self, columns: Iterable[str] = ()) -> None:
        self.measures = tuple(Measure(COLUMN + name, partial(_registered, name), heading_of(name)) for name in columns)


def _registered(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


EPISODE = EpisodeMeasures()


def register_measure_set(name: str, measures: MeasureSet) -> None:
    """Add a set of measures to every later evaluation of this process.

    Instead of calling this function, a package can declare an entry point of the group ``ethbrake_marl.first_edition.measure_sets``.
    Raises ``InvalidInput`` if ``measures`` is not a ``MeasureSet``, and ``AlreadyExists`` if another set has the same
    name, or if a measure of another set has the same name as a measure of this set.
    """
    if not isinstance(measures, MeasureSet):
        raise InvalidInput(f"set of measures {name!r} = {measures!r:.60}: must be a MeasureSet")
    others = [each for each in (EPISODE, *MEASURE_SETS.loaded.values()) if each is not measures]
    taken = {measure.name for each in others for measure in (*each.measures, *each.counted)}
    if twice := sorted(taken & {measure.name for measure in (*measures.measures, *measures.counted)}):
        raise AlreadyExists(
            f"set of measures {name!r}: another set already has measures with the names {', '.join(twice)}; choose"
            " other names"
        )
    MEASURE_SETS.add(name, measures, lambda other: other is measures)


MEASURE_SETS: Registry[MeasureSet] = Registry("set of measures", "first_edition.measure_sets", register_measure_set)


def contexts_of(evaluation: Any, *, long_list: bool = False) -> dict[str, Any]:
    """Return the context of each installed set of measures (``MeasureSet.prepare``), by the set's name.

    ``long_list`` says whether ``evaluation`` is one chunk of a list of more than 100,000 worlds, to which some sets do
    not apply. The context of a set that does not apply is ``Silent``.
    """
    silent = silent_in_long_lists() if long_list else {}
    return {name: silent.get(name) or evaluation.once(each.prepare) for name, each in MEASURE_SETS.items()}


def silent_in_long_lists() -> dict[str, Silent]:
    """Return ``Silent`` for each set of measures that does not apply to more than 100,000 worlds, by the set's name."""
    return {name: Silent(why) for name, each in MEASURE_SETS.items() if (why := each.not_in_long_lists)}


def silent_because(contexts: Mapping[str, Any]) -> dict[str, str | None]:
    """Return a dictionary: ``because_key`` of a set of measures -> why the set does not apply (None: it applies).

    ``contexts`` is the result of ``contexts_of``. Sets without a ``because_key`` are omitted.
    """
    by_key = {key: contexts[name] for name, each in MEASURE_SETS.items() if (key := each.because_key) is not None}
    return {key: context.because if isinstance(context, Silent) else None for key, context in by_key.items()}


def every_set(columns: Iterable[str] = ()) -> Iterator[tuple[str, MeasureSet]]:
    """Yield the name and the object of every set of measures, in the order of JSON results.

    The sets ``EpisodeMeasures`` and ``RegisteredMeasures(columns)`` have the name "".
    """
    yield "", EPISODE
    yield "", RegisteredMeasures(columns)
    yield from MEASURE_SETS.items()


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """Return the measures of all sets (``every_set``), in the order of JSON results."""
    return tuple(measure for _, each in every_set(columns) for measure in each.measures)
