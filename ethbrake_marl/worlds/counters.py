"""Random numbers by counter: world k of a seed has the same numbers, whatever else is drawn with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.motion.layout import Floats, Ints

Purpose = Literal["list", "training"]  # worlds for evaluation, or for training: two independent lists of one seed

Numbers = Callable[[int, tuple[int, ...]], Floats]  # (width, stream) -> uniform numbers of each world, [n, width]

PURPOSES: dict[str, int] = {"list": 0, "training": 1}

MOST_AT_ONCE = 10_000_000  # worlds of one call
_MOST_WORLDS = 2**52  # worlds of one seed: a clock holds their numbers as floats
_PER_COUNTER = 4  # 64-bit integers that Philox makes from one counter


def world_numbers(n: int, seed: int, first: int, purpose: str) -> Ints:
    """Raises ``InvalidInput`` for a bad argument."""
    check_whole_number("number of worlds", n, 1, MOST_AT_ONCE)
    check_whole_number("seed of the list", seed, 0)
    check_whole_number("first world", first, 0, _MOST_WORLDS)
    if purpose not in [*PURPOSES]:
        raise InvalidInput(f"sample: purpose = {purpose!r}: must be one of {', '.join(PURPOSES)}")
    return np.arange(int(first), int(first) + int(n), dtype=np.int64)


def uniform_numbers(seed: int, purpose: str, attempt: int, index: Ints) -> Numbers:
    """Source of random numbers for the worlds with the numbers ``index`` [n], in ascending order.

    The source is a function ``(width, stream)`` -> uniform numbers in [0, 1), [n, width]. ``stream`` names an
    independent sequence of random numbers; ``attempt`` counts, from 0, how often the worlds have been drawn again. A
    random number is the upper 53 bits of an integer from Philox, divided by 2^53. The key of Philox comes from seed,
    purpose, attempt and stream; world k has the counters from ``k width / 4`` on. A width is a multiple of 4.
    """
    first, count = int(index[0]), int(index[-1]) - int(index[0]) + 1

    def numbers(width: int, stream: tuple[int, ...]) -> Floats:
        sequence = np.random.SeedSequence([int(seed)], spawn_key=(PURPOSES[purpose], attempt, *stream))
        key = sequence.generate_state(2, np.uint64)
        philox = np.random.Philox(key=key, counter=first * (width // _PER_COUNTER))
        integers = np.asarray(philox.random_raw(count * width)).reshape(count, width)
        if count > len(index):
            integers = integers[index - first]
        integers >>= np.uint64(11)
        return np.multiply(integers, 2.0**-53, dtype=np.float64)

    return numbers
