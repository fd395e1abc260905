"""Threads that advance slices of many worlds at once. Kernels release Python's lock, so threads use several cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from ethbrake_marl.parallel import chosen_threads

LEAST_WORLDS = 16_384  # for fewer worlds a second thread costs more than it saves


def call_slices(call: Callable[[int, int], tuple[int, int]], n: int, threads: int) -> tuple[int, int]:
    """Result of ``call(first, end)`` for ``n`` rows, in slices that as many threads call at once.

    Each number of the result is the largest of all slices. Fewer than ``LEAST_WORLDS`` rows are one slice, without a
    thread.
    """
    if threads == 1 or n < LEAST_WORLDS:
        return call(0, n)
    threads = chosen_threads(threads)  # a process beside others has fewer cores than the one that opened the game
    ends = [n * thread // threads for thread in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        first, second = zip(*pool.map(call, ends[:-1], ends[1:]), strict=True)
    return max(first), max(second)
