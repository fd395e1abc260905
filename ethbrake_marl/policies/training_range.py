"""The range of what a policy observed in training, and which later observations lie outside."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.motion.layout import Bools
from ethbrake_marl.policies.observed import FiniteModel

OUTER_SHARE = 0.001  # share of the observed values below the range, and above it
FEATURES_OUTSIDE = 3  # an observation is outside if so many of its features are, each by more than MARGIN
MARGIN = 0.05  # as observed: 5 % of the feature's scale

Ends = Annotated[tuple[float, ...], Field(min_length=1, max_length=4096)]  # [F], as observed, scaled


class TrainingRange(FiniteModel):
    """Quantiles of each observed feature in the worlds of the training."""

    low: Ends
    high: Ends

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.low) != len(self.high) or not np.less_equal(self.low, self.high).all():
            raise ValueError("low, high: must have one number for each feature, low at most high")
        return self

    @classmethod
    def of(cls, observations: Observations) -> Self:
        """Range of ``observations`` [n, F]."""
        low = np.quantile(observations, OUTER_SHARE, axis=0, method="higher")
        high = np.quantile(observations, 1.0 - OUTER_SHARE, axis=0, method="lower")
        return cls(low=tuple(low.tolist()), high=tuple(high.tolist()))

    def is_outside(self, observations: Observations) -> Bools:
        """Whether each observation is outside, [n]; ``observations`` [n, F]."""
        low, high = (np.array(ends, np.float32) for ends in (self.low, self.high))
        beyond = (observations < low - MARGIN) | (observations > high + MARGIN)
        return np.asarray(beyond.sum(axis=1) >= FEATURES_OUTSIDE)
