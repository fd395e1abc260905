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
    """One measure of an agent: a rate where each world has a true/false value, a mean where it has a number.

    ``of`` is a function of the outcome and the context of the measure's set. It returns a value for every world, [n],
    or None where the outcome has none. Or ``of`` is the name of another measure, whose values are compared with the
    baseline.
    """

    name: str  # name in JSON
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # heading of its column in tables; "": no column
    short: str = ""  # heading in a terminal
    about: str = ""  # explanation for users; one is enough for headings that begin alike
    percent: bool = False  # whether tables show percent
    against: Literal["", "difference", "decrease"] = ""  # kind of comparison with the baseline, paired by world
    always: bool = True  # whether JSON shows null for a missing value, instead of omitting the key

    def values(self, outcome: Outcome, context: Any) -> Values | None:
        """Return the measure's value in every world of an outcome, [n]; None if the measure does not exist for it."""
        if isinstance(self.of, str) or isinstance(context, Silent):
            return None
        return self.of(outcome, context)

    def column(self) -> Column:
        """Return the measure's column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Silent:
    """Context of a set of measures that does not apply to an evaluation."""

    because: str  # reason, as a clause


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """Column of a set of measures in a table of several scenarios: one measure, and a note below the table."""

    column: Column
    measures: Mapping[HarmCount, str]  # name of the shown measure, by the harm that agents minimise
    note: str  # sentence with a placeholder ``{harm}``


class MeasureSet:
    """Measures that need the same knowledge of the worlds, their *context*, computed once per evaluation.

    A subclass lists its measures, and overrides the methods that it needs.
    """

    measures: tuple[Measure, ...] = ()
    counted: tuple[Measure, ...] = ()  # true/false measures that are only counted, for ``row``, without an interval
    baseline: str | None = None  # agent to compare with; None: the baseline of ``summarise``
    whole: str | None = None  # counted measure; unless it is true everywhere, no comparisons, and means marked "≥"
    narrow: tuple[str, ...] = ()  # columns that a narrow terminal shows, too, if they have values
    notebook: tuple[str, ...] = ()  # columns that a notebook shows
    group_column: GroupColumn | None = None
    per_world: Mapping[str, Callable[[Outcome, Any], Values | None]] = {}  # columns of files with every world
    texts: frozenset[str] = frozenset()  # names of the ``per_world`` columns that hold texts
    because_key: str | None = None  # key in a result's conditions for the reason why the set does not apply
    not_in_long_lists: str = ""  # why the set does not apply to lists that are not held in memory; "": it applies

    def prepare(self, evaluation: Any) -> Any:
        """Return the context that ``Measure.of`` gets for this ``Evaluation``, or ``Silent`` with a reason."""
        return None

    def row(self, tally: Any, worlds: int, context: Any) -> dict[str, Any]:
        """Return more fields of an agent's JSON object, computed from its ``AgentTally``.

        The keys must be the same where the set does not apply. ``context`` is None for a list that is not held in
        memory.
        """
        return {}

    def warnings(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return warnings about these rows (``SummaryRow``), as clauses."""
        return ()

    def notes(self, rows: Sequence[Any]) -> Sequence[str]:
        """Return notes below a table of these rows (``SummaryRow``), as sentences."""
        return ()


class EpisodeMeasures(MeasureSet):
    """The core's measures, which need no knowledge of the worlds beyond the episodes."""

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
    """Measures that the user registered, one for each column of an outcome; see ``register_measure``."""

    def __init__(self, columns: Iterable[str] = ()) -> None:
        self.measures = tuple(Measure(COLUMN + name, partial(_registered, name), heading_of(name)) for name in columns)


def _registered(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


EPISODE = EpisodeMeasures()


def register_measure_set(name: str, measures: MeasureSet) -> None:
    """Add a set of measures to every evaluation.

    This function also adds the entry points of ``ethbrake_marl.measure_sets``. Raises ``InvalidInput`` if ``measures``
    is not a ``MeasureSet``, ``AlreadyExists`` if the name of the set or of one of its measures is taken.
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
    """Return the context of every installed set for an evaluation, by the set's name; each is computed once.

    ``long_list``: the evaluation is a part of a list that is not held in memory.
    """
    silent = silent_in_long_lists() if long_list else {}
    return {name: silent.get(name) or evaluation.once(each.prepare) for name, each in MEASURE_SETS.items()}


def silent_in_long_lists() -> dict[str, Silent]:
    """Return the sets that do not apply to lists that are not held in memory, by name."""
    return {name: Silent(why) for name, each in MEASURE_SETS.items() if (why := each.not_in_long_lists)}


def silent_because(contexts: Mapping[str, Any]) -> dict[str, str | None]:
    """Return why sets do not apply, by their key in the conditions; None where they do."""
    found = {key: contexts[name] for name, each in MEASURE_SETS.items() if (key := each.because_key) is not None}
    return {key: context.because if isinstance(context, Silent) else None for key, context in found.items()}


def every_set(columns: Iterable[str] = ()) -> Iterator[tuple[str, MeasureSet]]:
    """Iterate over all sets by name, in the order of JSON; ``columns`` are an outcome's registered measures."""
    yield "", EPISODE
    yield "", RegisteredMeasures(columns)
    yield from MEASURE_SETS.items()


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """Return all measures, in the order of JSON; ``columns`` as in ``every_set``."""
    return tuple(measure for _, each in every_set(columns) for measure in each.measures)
