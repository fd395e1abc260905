"""Parts of a batch on several threads. Kernels release the interpreter's lock, and worlds do not see each other."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ethbrake_marl.errors import InvalidInput

Result = TypeVar("Result")


def by_parts(work: Callable[[slice], Result], n: int, threads: int) -> list[Result]:
    """Results of ``work`` on up to ``threads`` neighbouring parts of ``n`` rows, in order of the rows.

    The first part is done by the caller's own thread, so 1 thread means no others. If parts fail, the error of the
    first of them is raised after all have ended. Raises ``InvalidInput`` unless ``threads`` is a whole number >= 1.
    """
    if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or not threads >= 1:
        raise InvalidInput(f"threads = {threads!r}: must be a whole number, at least 1")
    parts = min(int(threads), n)
    if parts <= 1:
        return [work(slice(0, n))]
    bounds = [n * p // parts for p in range(parts + 1)]
    slices = [slice(low, high) for low, high in pairwise(bounds)]
    with ThreadPoolExecutor(parts - 1) as pool:
        others = [pool.submit(work, part) for part in slices[1:]]
        return [work(slices[0]), *(other.result() for other in others)]
