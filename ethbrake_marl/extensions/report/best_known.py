"""Best known harm of each world, if another extension has measured it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import COLUMN, HARM
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.motion.layout import Bools, Floats

REPORT_MEASURES = ("limits", "avoidable", "proven_harm")  # names for ``evaluate(measures=...)``
BEST = {count: f"best_known_{count}" for count in COLUMN}  # count -> column; not all lists have the honest cost
AVOIDABLE_COLUMN = "avoidable"  # whether contact is proven avoidable; where it is false, proven unavoidable
UNAVOIDABLE = "proven_harm_impact"  # whether it is proven that no command avoids an impact


class BestKnown(NamedTuple):
    """Least known harm in each of n worlds, and what is proven about contacts and impacts."""

    harm: Mapping[str, Floats]  # count -> [n] m2/s2: both harms and, if it is known, the honest cost
    avoidable: Bools | None  # [n] whether contact can be avoided (proven); None: not measured
    unavoidable: Bools | None = None  # [n] whether no command avoids an impact (proven); None: not measured

    @classmethod
    def of(cls, result: Result) -> BestKnown | None:
        columns: Mapping[str, Any] = next(iter(result.columns.values()))
        harm = {count: columns[name] for count, name in BEST.items() if name in columns}
        return (
            cls(harm, columns.get(AVOIDABLE_COLUMN), columns.get(UNAVOIDABLE)) if HARM.keys() <= harm.keys() else None
        )

    def regret(self, result: Result, agent: str, count: str) -> Floats:
        return np.asarray(result[agent][COLUMN[count]] - self.harm[count])


def shown_counts(compared: Comparison) -> dict[str, str]:
    """First-impact harm, total harm, and what agents minimise unless its best is not known: count -> column."""
    best_known, minimised = BestKnown.of(compared.result), compared.harm_count
    return (
        HARM if best_known is not None and minimised not in best_known.harm else {**HARM, minimised: COLUMN[minimised]}
    )
