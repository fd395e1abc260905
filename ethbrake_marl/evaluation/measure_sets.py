"""Measures of an agent, the sets that they form, and the core's set, which measures the episode.

A measure is a formula that turns an agent's outcome into one value per world. Measures that need the same knowledge of
the worlds form a set. Extensions add sets by entry points of the group ``ethbrake_marl.measure_sets``: tables, JSON and
files show the measures of every installed set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.exploits import FAR_M
from ethbrake_marl.evaluation.outcome import COLUMN, Outcome, Values
from ethbrake_marl.evaluation.own_measures import heading_of
from ethbrake_marl.files.sheet import Column
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.registry import Registry

BASELINE = "full_brake"


@dataclass(frozen=True, slots=True)
class Measure:
    """One measure of an agent. Tables show its rate if its values are true/false, its mean if they are numbers.

    ``of`` is a function that takes the agent's outcome and the context that ``MeasureSet.prepare`` returned. It returns
    a value for every world, [n], or None if the measure does not exist for this outcome. Alternatively ``of`` is the
    name of another measure: then this measure compares the values of that one with the baseline's, as ``against`` says.
    """

    name: str  # key in JSON results, unique among all measures
    of: Callable[[Outcome, Any], Values | None] | str  # how the values are computed, see above
    heading: str = ""  # heading of its column in tables; "": no column
    short: str = ""  # short heading for terminals, possibly with line breaks
    about: str = ""  # explanation for users; "": that of the measure whose heading begins with the same words
    percent: bool = False  # whether tables show percent
    # Comparison with the baseline, paired by world: none, mean difference, or relative decrease of the mean.
    against: Literal["", "difference", "decrease"] = ""
    always: bool = True  # whether JSON shows null for a missing value, instead of omitting the key

    def values(self, outcome: Outcome, context: Any) -> Values | None:
        """Return the measure's value in every world of an outcome, [n].

        ``context`` is what the measure's set prepared for the evaluation (``contexts_of``). Returns None if the measure
        only compares another one with a baseline, if its set does not apply (context ``Silent``), or if the outcome
        lacks it.
        """
        if isinstance(self.of, str) or isinstance(context, Silent):
            return None
        return self.of(outcome, context)

    def column(self) -> Column:
        """Return the measure's column in a table: heading, name, and how its numbers are shown."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Silent:
    """Context of a set of measures that does not apply to an evaluation; its measures then have no values."""

    because: str  # reason for users, as a clause without capital and full stop


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """Column that a set of measures adds to the table of ``ethbrake evaluate`` on a group of scenarios."""

    column: Column  # heading, and how the numbers are shown
    measures: Mapping[HarmCount, str]  # harm count that the agents minimise -> name of the measure to show
    note: str  # sentence below the table; its placeholder ``{harm}`` becomes ``first-impact`` or ``total``


class MeasureSet:
    """Base class of a set of measures that are computed from the same knowledge of the worlds.

    A subclass must list its measures in ``measures``. It may override ``prepare``, which computes the common knowledge
    (the *context*) once per evaluation; ``row``, which adds fields to JSON results; and ``warnings`` and ``notes``,
    which add texts to a results table. By default there is no context, and nothing is added.
    """

    measures: tuple[Measure, ...] = ()  # measures with a column or a JSON key, in the order of JSON
    counted: tuple[Measure, ...] = ()  # true/false measures without a column, whose true worlds ``row`` can read
    baseline: str | None = None  # agent to compare with; None: the baseline of ``summarise``
    # Name of a measure in ``counted`` that says whether a world's values are complete. If it is false in some world,
    # means are marked "≥" and comparisons are omitted. None: all values are complete.
    whole: str | None = None
    narrow: tuple[str, ...] = ()  # names of measures that a narrow terminal also shows, if they have values
    notebook: tuple[str, ...] = ()  # names of measures that a notebook shows
    group_column: GroupColumn | None = None  # column in the table of a group of scenarios; None: no column
    # Columns of files with one row per world: name -> function of outcome and context that returns values [n], or None.
    per_world: Mapping[str, Callable[[Outcome, Any], Values | None]] = {}
    texts: frozenset[str] = frozenset()  # names of the ``per_world`` columns that hold texts
    because_key: str | None = None  # key in a result's conditions for the reason why the set does not apply
    not_in_long_lists: str = ""  # why the set does not apply to lists of more than 100,000 worlds; "": it applies

    def prepare(self, evaluation: Any) -> Any:
        """Return the context of this ``Evaluation``, which ``Measure.of`` gets as its second argument.

        Return ``Silent`` with a reason if the set does not apply.
        """
        return None

    def row(self, tally: Any, worlds: int, context: Any) -> dict[str, Any]:
        """Return fields that the set adds to an agent's object in the JSON results.

        The keys must be the same whether or not the set applies.

        Args:
            tally: the agent's ``AgentTally``, with the sums of its measures.
            worlds: number of evaluated worlds.
            context: what ``prepare`` returned, or ``Silent`` if the set does not apply; None for a list of more than
                100,000 worlds.

        """
        return {}

    def warnings(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return warnings about a results table, each a clause without capital and full stop; by default none.

        ``rows`` are the table's rows (``SummaryRow``, one per agent).
        """
        return ()

    def notes(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return notes to print below a results table, each a whole sentence; by default none.

        ``rows`` are the table's rows (``SummaryRow``, one per agent).
        """
        return ()


class EpisodeMeasures(MeasureSet):
    """The core's measures, computed from the episodes alone; their context is None."""

    measures = (
        Measure(
            "collision_rate", lambda o, _: o.collided, "Collisions", percent=True,
            about="Share of worlds with at least one impact; Wilson's interval. Every agent meets the same worlds, each"
            " once.",
        ),
        Measure(
            "first_impact_harm", lambda o, _: o.first_impact_harm, "First-impact harm", "First-impact\nharm",
            "Squared closing speed (m²/s²), summed over the pairs, each pair's first impact only (the paper's"
            " protocol); mean per world.",
        ),
        Measure(
            "total_harm", lambda o, _: o.total_harm, "Total harm", "Total\nharm",
            "The same over every impact. A light early touch makes a later, harder impact of the same pair free under"
            " the first count, so both are shown.",
        ),
        Measure(
            "sampled_harm", lambda o, _: o.sampled_harm, "Sampled harm", "Sampled\nharm",
            "The paper's own sum (its eq. Jharm): the agent's commands replayed through the paper's fixed-step map at"
            " the time step; at every sample each pair that overlaps and closes adds its squared closing speed (m²/s²),"
            " so pushing costs harm for as long as it lasts.",
        ),
        Measure(
            "vehicle_1_shoved_m", lambda o, _: o.shoved_m, "Vehicle 1 shoved (m)", "Shoved\nm",
            "How far Vehicle 1 ends beyond the point where it would stop by itself, mean per world; and the share of"
            " worlds in which that is more than 5 m. Both counts of harm leave pushing free unless something stands"
            " ahead; Vehicle 1 brakes for something.",
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
            about="The same of total harm.",
        ),
        Measure(
            "harm_decrease_first", "first_impact_harm", "Decrease, first-impact", "Decrease\nfirst",
            "1 − harm / harm of full braking in the same worlds; interval by the delta method, paired by world.",
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
            "What the agent itself expected at the alert, under the count that it minimises.", always=False,
        ),
    )  # fmt: skip
    counted = (Measure("horizon_ends", lambda o, _: ~o.at_rest), Measure("policy_share", lambda o, _: o.chosen_policy))
    narrow = ("harm_decrease_first", "harm_decrease_total")
    notebook = ("collision_rate", "first_impact_harm", "total_harm", "harm_decrease_first")


class RegisteredMeasures(MeasureSet):
    """Measures that the user registered with ``register_measure``, one for each of ``Outcome.metrics``.

    Args:
        columns: keys of ``Outcome.metrics``.

    """

    def __init__(self, columns: Iterable[str] = ()) -> None:
        self.measures = tuple(Measure(COLUMN + name, partial(_registered, name), heading_of(name)) for name in columns)


def _registered(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


EPISODE = EpisodeMeasures()


def register_measure_set(name: str, measures: MeasureSet) -> None:
    """Add a set of measures to every evaluation, under a name that is a key of ``MEASURE_SETS``.

    An installed package does the same with an entry point of the group ``ethbrake_marl.measure_sets``. Raises
    ``InvalidInput`` if ``measures`` is not a ``MeasureSet``, ``AlreadyExists`` if the name of the set or of one of its
    measures is taken.
    """
    if not isinstance(measures, MeasureSet):
        raise InvalidInput(f"set of measures {name!r}: must be a MeasureSet")
    others = [each for each in (EPISODE, *MEASURE_SETS.loaded.values()) if each is not measures]
    taken = {measure.name for each in others for measure in (*each.measures, *each.counted)}
    if twice := sorted(taken & {measure.name for measure in (*measures.measures, *measures.counted)}):
        raise AlreadyExists(f"set of measures {name!r}: another set has {', '.join(twice)}; give other names")
    MEASURE_SETS.add(name, measures, lambda other: other is measures)


MEASURE_SETS: Registry[MeasureSet] = Registry("set of measures", "measure_sets", register_measure_set)


def contexts_of(evaluation: Any, *, long_list: bool = False) -> dict[str, Any]:
    """Return the context of each installed set of measures for an ``Evaluation``, by the set's name.

    The context is what ``MeasureSet.prepare`` returned: the set's knowledge of the worlds, or ``Silent`` with the
    reason why the set does not apply. It is computed once per evaluation. ``long_list``: the evaluation is a part of a
    list of more than 100,000 worlds, to which some sets do not apply.
    """
    silent = silent_in_long_lists() if long_list else {}
    return {name: silent.get(name) or evaluation.once(each.prepare) for name, each in MEASURE_SETS.items()}


def silent_in_long_lists() -> dict[str, Silent]:
    """Return why sets of measures do not apply to lists of more than 100,000 worlds: name of the set -> ``Silent``."""
    return {name: Silent(why) for name, each in MEASURE_SETS.items() if (why := each.not_in_long_lists)}


def silent_because(contexts: Mapping[str, Any]) -> dict[str, str | None]:
    """Return why sets of measures do not apply, by ``MeasureSet.because_key``; None for a set that applies.

    ``contexts`` are those of ``contexts_of``. Sets without such a key are omitted.
    """
    by_key = {key: contexts[name] for name, each in MEASURE_SETS.items() if (key := each.because_key) is not None}
    return {key: context.because if isinstance(context, Silent) else None for key, context in by_key.items()}


def every_set(columns: Iterable[str] = ()) -> Iterator[tuple[str, MeasureSet]]:
    """Yield (name, set) for all sets of measures, in the order in which JSON results hold their measures.

    The set of the core (``EpisodeMeasures``) and that of the user's measures have the name "". ``columns`` are the keys
    of ``Outcome.metrics``, the measures that the user registered.
    """
    yield "", EPISODE
    yield "", RegisteredMeasures(columns)
    yield from MEASURE_SETS.items()


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """Return the measures of all sets, in the order in which JSON results hold them.

    ``columns`` are the keys of ``Outcome.metrics``, the measures that the user registered.
    """
    return tuple(measure for _, each in every_set(columns) for measure in each.measures)
