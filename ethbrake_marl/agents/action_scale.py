"""An offset and a scale of actions, with which an untrained policy begins near a chosen action."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.motion.layout import Floats

REACH = 3.0  # an untrained Gaussian policy (mean 0, deviation 1) rarely chooses a larger number


class ActionScale(NamedTuple):
    """The number a that a policy chooses stands for the action ``offset + scale * a``, clipped to [-1, 1].

    Environments then have numbers from -3 to 3 or, with ``choices``, indices of so many evenly spaced ones.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> eb.ActionScale(offset=-0.9, scale=0.3).actions(np.array([-1.0, 0.0, 2.0])).round(9)
    array([-1. , -0.9, -0.3])

    """

    offset: float
    scale: float
    choices: int | None = None

    def actions(self, numbers: Floats) -> Floats:
        """Actions in [-1, 1]."""
        return np.asarray(np.clip(self.offset + self.scale * numbers, -1.0, 1.0))


ActionForm = int | ActionScale | None  # number of evenly spaced actions, a scale, or numbers in [-1, 1]


def count_in(form: ActionForm, who: str = "actions") -> int | None:
    """Number of indices, or None for numbers. Raises ``InvalidInput``, beginning with ``who``."""
    count = form.choices if isinstance(form, ActionScale) else form
    if isinstance(form, ActionScale):
        are_numbers = all(isinstance(number, Real) for number in (form.offset, form.scale))
        if not are_numbers or not (-1.0 <= form.offset <= 1.0 and 0.0 < form.scale < math.inf):
            raise InvalidInput(f"{who} = {form}: the offset must be a number from -1 to 1, and the scale one above 0")
    if count is not None:
        check_whole_number(who, count, 2)
    return count
