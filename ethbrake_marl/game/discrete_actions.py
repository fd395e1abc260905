"""Discrete actions: indices of evenly spaced actions from -1 (index 0) to 1 (the last index)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Floats, Ints, real_numbers


def index_to_action(indices: ArrayLike, count: int, names: str = "the learners") -> Floats:
    """Return the action in [-1, 1] of each index, float64 of the same shape: (2 k - K + 1) / (K - 1).

    k is an index, K the ``count``. An odd K has an action that is exactly 0, in the middle.

    Args:
        indices: whole numbers from 0 (full braking capacity) to ``count - 1`` (full driving capacity), of any shape.
        count: number of actions, at least 2.
        names: whose actions these are, for error messages.

    Raises ``InvalidInput`` as ``checked_indices`` does.

    >>> from ethbrake_marl.game.discrete_actions import index_to_action
    >>> index_to_action([0, 1, 4, 8], 9)
    array([-1.  , -0.75,  0.  ,  1.  ])

    """
    return np.asarray((2 * checked_indices(indices, count, names) - (count - 1)) / (count - 1))


def checked_indices(indices: ArrayLike, count: int, names: str) -> Ints:
    """Return the indices as int64 of the same shape.

    Raises ``InvalidInput`` for a value that is not a whole number from 0 to ``count - 1``. A float is refused, also
    3.0: it would be an action in [-1, 1] without ``actions=``.
    """
    right = f"with actions={count} an index is needed, a whole number from 0 to {count - 1}"
    try:
        real_numbers(indices)
    except ValueError as error:
        raise InvalidInput(f"action of {names}: {indices!r} {error}; {right}") from None
    numbers = np.asarray(indices)
    if numbers.dtype.hasobject:
        numbers = np.array(numbers.tolist())
    good = (numbers >= 0) & (numbers < count) & (np.floor(numbers) == numbers)
    wrong = numbers[~good] if not good.all() else numbers[numbers.dtype.kind not in "iu"]
    if wrong.size:
        raise InvalidInput(f"action of {names}: {wrong.ravel().tolist()[0]!r}; {right}")
    return numbers.astype(np.int64)
