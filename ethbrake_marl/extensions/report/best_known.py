"""Best known harm of each world, if another extension has measured it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import IMPACT_COUNTS, HarmCount, all_counts
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.motion.layout import Bools, Floats

REPORT_MEASURES = ("limits", "contact_avoidable", "proven_harm")  # names for ``evaluate(measures=...)``
CONTACT_AVOIDABLE = "contact_avoidable"  # whether contact is proven avoidable; where it is false, proven unavoidable
IMPACT_UNAVOIDABLE = "proven_harm_impact"  # whether it is proven that no command avoids an impact


class BestKnown(NamedTuple):
    """Least known harm in each of n worlds, and what is proven about contacts and impacts."""

    harm: Mapping[HarmCount, Floats]  # count -> [n] m2/s2: both harms, and other counts that are known
    contact_avoidable: Bools | None  # [n] whether contact can be avoided (proven); None: not measured
    impact_unavoidable: Bools | None = None  # [n] whether no command avoids an impact (proven); None: not measured

    @classmethod
    def of(cls, result: Result) -> BestKnown | None:
        columns: Mapping[str, Any] = next(iter(result.columns.values()))
        names = {count: f"best_known_{count.name}" for count in all_counts()}
        harm = {count: columns[name] for count, name in names.items() if name in columns}
        if not {*IMPACT_COUNTS} <= {*harm}:
            return None
        return cls(harm, columns.get(CONTACT_AVOIDABLE), columns.get(IMPACT_UNAVOIDABLE))

    def regret(self, result: Result, agent: str, count: HarmCount) -> Floats:
        return np.asarray(result[agent][count.column] - self.harm[count])


def shown_counts(compared: Comparison) -> list[HarmCount]:
    """First-impact harm, total harm, and what agents minimise, as far as their best is known."""
    best_known = BestKnown.of(compared.result)
    counts = [*dict.fromkeys([*IMPACT_COUNTS, compared.harm_count])]
    return counts if best_known is None else [count for count in counts if count in best_known.harm]
