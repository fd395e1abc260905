"""Discrete actions: an index selects one of K evenly spaced actions, from -1 (index 0) to 1 (index K - 1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.state import Floats, Ints, real_numbers


def index_to_action(indices: ArrayLike, count: int, names: str = "the learners") -> Floats:
    """Return the action ``(2 k - K + 1) / (K - 1)`` in [-1, 1] for each index k, where K is ``count``.

    The result is float64 and has the shape of ``indices``. If the number of actions is odd, the action in the middle is
    exactly 0. Index 0 is full braking and ``count - 1`` full driving; ``count`` is at least 2. ``names`` are the names
    of the vehicles that act, for error messages. Raises the same ``InvalidInput`` as ``checked_indices``.

    >>> from ethbrake_marl.first_edition.game.discrete_actions import index_to_action
    >>> index_to_action([0, 1, 4, 8], 9)
    array([-1.  , -0.75,  0.  ,  1.  ])
    """
    return np.asarray((2 * checked_indices(indices, count, names) - (count - 1)) / (count - 1))


def checked_indices(indices: ArrayLike, count: int, names: str) -> Ints:
    """Return the indices of discrete actions as an int64 array of the same shape.

    Raises ``InvalidInput`` for a value that is not a whole number from 0 to ``count - 1``. A float such as 1.0 is also
    invalid, because the caller probably means a continuous action. For ``names``, see ``index_to_action``.
    """
    right = f"with actions={count}, an action must be an index, a whole number from 0 to {count - 1}"
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
        raise InvalidInput(f"action of {names} = {wrong.ravel().tolist()[0]!r}: {right}")
    return numbers.astype(np.int64)
