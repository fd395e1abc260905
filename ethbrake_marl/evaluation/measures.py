"""Measures of an agent, the sets they come in, and the core's set, which is about the episode.

A measure is a formula from what an agent did in every world to a value per world. Measures that need to know the same
thing of the worlds form a set. Extensions add sets by entry points of the
group ``ethbrake_marl.measure_sets``: tables, JSON and files show the measures of every set that is installed.
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
    """One thing that is said of every agent: a rate where each world has a truth, a mean where it has a number.

    ``of`` takes the outcome and the context of the measure's set. It gives a value for every world, [n], or None where
    this outcome has none. Or ``of`` is the name of the measure that is compared with the baseline.
    """

    name: str  # in JSON
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # of its column in tables; "": in none
    short: str = ""  # the same in a terminal
    about: str = ""  # what it means; stands once for headings that begin alike
    percent: bool = False  # how a table shows it
    against: Literal["", "difference", "decrease"] = ""  # how it is compared with the baseline, paired by world
    always: bool = True  # JSON shows it as null where it does not exist

    def values(self, outcome: Outcome, context: Any) -> Values | None:
        """The value in every world of an outcome, [n]; None without one."""
        if isinstance(self.of, str) or isinstance(context, Silent):
            return None
        return self.of(outcome, context)

    def column(self) -> Column:
        """Its column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Silent:
    """The context of a set that has nothing to say of an evaluation."""

    because: str  # a clause


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """What a table of several scenarios shows of a set: one measure, and what stands below about it."""

    column: Column
    measures: Mapping[HarmCount, str]  # by the harm that agents minimise
    note: str  # a sentence with ``{harm}`` in it


class MeasureSet:
    """Measures that need to know the same thing of the worlds: their *context*, computed once for an evaluation.

    A subclass names its measures, and overrides the methods that it needs.
    """

    measures: tuple[Measure, ...] = ()
    counted: tuple[Measure, ...] = ()  # truths that are counted for ``row``, without an interval
    baseline: str | None = None  # the agent that they are compared with; None: the one that ``summarise`` is asked for
    whole: str | None = None  # a counted truth: unless it holds everywhere, nothing is compared, and means have a "≥"
    narrow: tuple[str, ...] = ()  # columns that also a narrow terminal shows, where they have values
    notebook: tuple[str, ...] = ()  # columns that a notebook shows
    group_column: GroupColumn | None = None
    per_world: Mapping[str, Callable[[Outcome, Any], Values | None]] = {}  # columns of files with every world
    texts: frozenset[str] = frozenset()  # those of them that hold texts
    because_key: str | None = None  # under which the conditions of a result say why the set is silent
    not_in_long_lists: str = ""  # why it is silent about lists that are not held in memory; "": it is not

    def prepare(self, evaluation: Any) -> Any:
        """The context that ``Measure.of`` gets for this ``Evaluation``, or ``Silent`` with a reason."""
        return None

    def row(self, tally: Any, worlds: int, context: Any) -> dict[str, Any]:
        """More fields of an agent's object in JSON, from its ``AgentTally``; the same keys where it is silent.

        ``context`` is None for a list that is not held in memory.
        """
        return {}

    def warnings(self, rows: Sequence[Any]) -> Sequence[str]:
        """What must not be overlooked about these ``SummaryRow``, as clauses."""
        return ()

    def notes(self, rows: Sequence[Any]) -> Sequence[str]:
        """What stands below a table of these ``SummaryRow``, as sentences."""
        return ()


class EpisodeMeasures(MeasureSet):
    """What agents did, whatever else is known of the worlds."""

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
    """Measures of the user's own, by the columns that an outcome has of them; see ``register_measure``."""

    def __init__(self, columns: Iterable[str] = ()) -> None:
        self.measures = tuple(Measure(COLUMN + name, partial(_registered, name), heading_of(name)) for name in columns)


def _registered(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


EPISODE = EpisodeMeasures()


def register_measure_set(name: str, measures: MeasureSet) -> None:
    """Make every evaluation show these measures; an entry point of ``ethbrake_marl.measure_sets`` is registered so.

    Raises ``InvalidInput`` for what is no set, ``AlreadyExists`` for a set or a measure whose name is taken.
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
    """Context of every installed set for an evaluation, by the set's name; each is computed once.

    ``long_list``: the evaluation is a part of a list that is not held in memory.
    """
    silent = silent_in_long_lists() if long_list else {}
    return {name: silent.get(name) or evaluation.once(each.prepare) for name, each in MEASURE_SETS.items()}


def silent_in_long_lists() -> dict[str, Silent]:
    """The sets that are silent about lists that are not held in memory, by name."""
    return {name: Silent(why) for name, each in MEASURE_SETS.items() if (why := each.not_in_long_lists)}


def silent_because(contexts: Mapping[str, Any]) -> dict[str, str | None]:
    """Why sets are silent, by the keys of the conditions; None where they are not."""
    found = {key: contexts[name] for name, each in MEASURE_SETS.items() if (key := each.because_key) is not None}
    return {key: context.because if isinstance(context, Silent) else None for key, context in found.items()}


def every_set(columns: Iterable[str] = ()) -> Iterator[tuple[str, MeasureSet]]:
    """All sets by name, in the order of JSON; ``columns`` are those of registered measures, as an outcome has them."""
    yield "", EPISODE
    yield "", RegisteredMeasures(columns)
    yield from MEASURE_SETS.items()


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """All measures, in the order of JSON; ``columns`` as in ``every_set``."""
    return tuple(measure for _, each in every_set(columns) for measure in each.measures)
