"""The measures of an evaluation: name, heading, meaning and formula of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ethbrake_marl.evaluation.exploits import FAR_M
from ethbrake_marl.evaluation.outcome import COLUMN, Outcome, Values
from ethbrake_marl.evaluation.own_measures import heading_of
from ethbrake_marl.extensions.search.regret import Regrets
from ethbrake_marl.files.sheet import Column

BASELINE = "full_brake"


@dataclass(frozen=True, slots=True)
class Measure:
    """Something that is told of every agent: where each world has a truth, a rate; where it has a number, a mean.

    ``of`` gives the values of all worlds, [n], from outcome and limits (None where nothing is proven), or None where
    there are none; or it names the measure whose values these are.
    """

    name: str  # in JSON
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # of its column in tables; "": in none
    short: str = ""  # the same in a terminal
    about: str = ""  # what it means; stands once for headings that begin alike
    percent: bool = False  # how a table shows it
    against: Literal["", "difference", "decrease"] = ""  # of the baseline, paired by world
    limits: bool = False  # it needs them
    always: bool = True  # JSON tells it where it does not exist, too: null

    def values(self, outcome: Outcome, regrets: Regrets | None) -> Values | None:
        """Those of an outcome."""
        if isinstance(self.of, str) or (self.limits and regrets is None):
            return None
        return self.of(outcome, regrets)

    def column(self) -> Column:
        """Its column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


_OF_THE_EPISODE = (
    Measure(
        "collision_rate", lambda o, _: o.collided, "Collisions", percent=True,
        about="Share of worlds with at least one impact; Wilson's interval. Every agent meets the same worlds, each"
        " once.",
    ),
    Measure(
        "first_impact_harm", lambda o, _: o.first_impact_harm, "First-impact harm", "First-impact\nharm",
        "Squared closing speed (m²/s²), summed over the pairs, each pair's first impact only (the paper's protocol);"
        " mean per world.",
    ),
    Measure(
        "total_harm", lambda o, _: o.total_harm, "Total harm", "Total\nharm",
        "The same over every impact. A light early touch makes a later, harder impact of the same pair free under the"
        " first count, so both are shown.",
    ),
    Measure(
        "sampled_harm", lambda o, _: o.sampled_harm, "Sampled harm", "Sampled\nharm",
        "The paper's own sum (its eq. Jharm): the agent's commands replayed through the paper's fixed-step map at the"
        " time step; at every sample each pair that overlaps and closes adds its squared closing speed (m²/s²), so"
        " pushing costs harm for as long as it lasts.",
    ),
    Measure(
        "vehicle_1_shoved_m", lambda o, _: o.shoved_m, "Vehicle 1 shoved (m)", "Shoved\nm",
        "How far Vehicle 1 ends beyond the point where it would stop by itself, mean per world; and the share of worlds"
        " in which that is more than 5 m. Both counts of harm leave pushing free unless something stands ahead; Vehicle"
        " 1 brakes for something.",
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
        lambda o, _: None if o.predicted_harm is None or not np.isfinite(o.predicted_harm).all() else o.predicted_harm,
        "Predicted harm", "Pre-\ndicted",
        "What the agent itself expected at the alert, under the count that it minimises.", always=False,
    ),
)  # fmt: skip

_OF_THE_LIMITS = (
    Measure(
        "unavoidable_rate", lambda _, r: None if r.avoidable is None else ~r.avoidable, limits=True,
        about="Share of worlds in which contact is proven unavoidable.",
    ),
    Measure(
        "impact_proven_rate", lambda _, r: r.limits.proof.impact, limits=True,
        about="Share of worlds in which an impact is proven unavoidable.",
    ),
    Measure(
        "avoidable_collision_rate",
        lambda o, r: None if r.avoidable is None else o.collided & r.avoidable, limits=True,
        about="Share of worlds with a collision, though contact is proven avoidable.",
    ),
    Measure(
        "best_known_first_impact_harm", lambda _, r: r.first_impact_harm, limits=True,
        about="The least first-impact harm known of the same worlds.",
    ),
    Measure(
        "best_known_total_harm", lambda _, r: r.total_harm, limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "proven_harm", lambda _, r: r.limits.proof.harm, limits=True,
        about="Proven: nobody can do less.",
    ),
    Measure(
        "best_known_minus_proven_first", lambda _, r: r.first_impact_harm - r.limits.proof.harm, limits=True,
        about="What is left between the best known and the proof.",
    ),
    Measure(
        "best_known_minus_proven_total", lambda _, r: r.total_harm - r.limits.proof.harm, limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "mean_regret", "mean_regret_first", limits=True,
        about="The same as mean_regret_first.",
    ),
    Measure(
        "mean_regret_first", lambda o, r: r.regret(o, "first"), "Regret, first-impact", "Regret\nfirst",
        "First-impact harm minus the best known first-impact harm of the same world; mean per world. The best known is"
        " 0 where contact is proven avoidable, else the result of a search over whole profiles of Vehicle 2, or of an"
        " agent in this table that did better. With ≥: the best of some world is known from these agents alone.",
        limits=True,
    ),
    Measure(
        "mean_regret_total", lambda o, r: r.regret(o, "total"), limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "share_of_possible_reduction", "mean_regret_first", against="decrease", limits=True,
        about="The same as share_of_possible_reduction_first.",
    ),
    Measure(
        "share_of_possible_reduction_first", "mean_regret_first", "Share of the possible reduction, first-impact",
        "Share of\npossible",
        "(Full braking − agent) / (full braking − best known), first-impact harm: how much of the reduction of harm"
        " that is known to be possible the agent brings.",
        percent=True, against="decrease", limits=True,
    ),
    Measure(
        "share_of_possible_reduction_total", "mean_regret_total", against="decrease", limits=True,
        about="The same of total harm.",
    ),
)  # fmt: skip

HORIZON, CHOSEN, KNOWN, BELOW = "horizon_ends", "policy_share", "known", "below_best_known"

COUNTED = (  # told as numbers of worlds or shares, without an interval
    Measure(HORIZON, lambda o, _: ~o.at_rest),
    Measure(CHOSEN, lambda o, _: o.chosen_policy),
    Measure(KNOWN, lambda _, r: r.limits.known, limits=True),
    Measure(BELOW, lambda o, r: r.below(o), limits=True),
)


def _registered_values(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """All that are told, in the order of JSON; ``columns`` are those of registered measures, as an outcome has them."""
    own = [Measure(COLUMN + name, partial(_registered_values, name), heading_of(name)) for name in columns]
    return (*_OF_THE_EPISODE, *own, *_OF_THE_LIMITS)
