"""The best known harm of each world, if a result has it: a package that searches registers measures of these names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.motion.layout import Bools, Floats

MEASURE = "limits"  # a name for ``evaluate(measures=...)``
HARM = {"first": "first_impact_harm", "total": "total_harm"}  # count -> column
AVOIDABLE = "limits_avoidable"  # whether contact is proven avoidable; where it is false, proven unavoidable


class BestKnown(NamedTuple):
    """What is the least that is known for each world; the same for every agent."""

    harm: Mapping[str, Floats]  # count -> [n] m2/s2
    avoidable: Bools | None  # [n] whether contact can be avoided; None: not proven

    @classmethod
    def of(cls, result: Result) -> BestKnown | None:
        """Return what a result knows; None if it was not measured."""
        columns: Mapping[str, Any] = next(iter(result.columns.values()))
        names = {count: f"{MEASURE}_best_known_{harm}" for count, harm in HARM.items()}
        if not all(name in columns for name in names.values()):
            return None
        return cls({count: columns[name] for count, name in names.items()}, columns.get(AVOIDABLE))

    def regret(self, result: Result, agent: str, count: str) -> Floats:
        """Return an agent's harm minus the best known harm, [n] m2/s2."""
        return np.asarray(result[agent][HARM[count]] - self.harm[count])
