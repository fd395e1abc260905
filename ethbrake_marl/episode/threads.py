"""Threads that advance slices of many worlds at once. Kernels release Python's lock, so threads use several cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from ethbrake_marl.errors import InvalidInput, check_whole_number

LEAST_WORLDS = 16_384  # for fewer worlds a second thread costs more than it saves
MOST_THREADS = 1024
VARIABLE = "ETHBRAKE_THREADS"  # environment variable: number of threads where the caller sets none


def chosen_threads(threads: int | None) -> int:
    """The number ``threads``; None: the environment variable ``ETHBRAKE_THREADS``, or 1.

    Raises ``InvalidInput`` unless it is a whole number from 1 to 1024.
    """
    if threads is None:
        text = os.environ.get(VARIABLE, "1")
        if not (text.isascii() and text.isdecimal() and len(text) < 5 and 1 <= int(text) <= MOST_THREADS):
            raise InvalidInput(f"{VARIABLE} = {text!r:.60}: must be a whole number from 1 to {MOST_THREADS}")
        return int(text)
    check_whole_number("threads", threads, 1, MOST_THREADS)
    return int(threads)


def call_slices(call: Callable[[int, int], tuple[int, int]], n: int, threads: int) -> tuple[int, int]:
    """Result of ``call(first, end)`` for ``n`` rows, in slices that as many threads call at once.

    Each number of the result is the largest of all slices. Fewer than ``LEAST_WORLDS`` rows are one slice, without a
    thread.
    """
    if threads == 1 or n < LEAST_WORLDS:
        return call(0, n)
    ends = [n * thread // threads for thread in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        first, second = zip(*pool.map(call, ends[:-1], ends[1:]), strict=True)
    return max(first), max(second)
