"""GPU kernels: each thread takes memory of its own, and calls a function of ``kernels`` or ``search_kernels``.

numba's simulator runs them without a GPU. This module is imported only when needed, because numba.cuda is slow to
import.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import cuda, float32, float64, int64, uint64

from ethbrake_marl.extensions.cuda.kernels import Mine, play
from ethbrake_marl.extensions.cuda.search_kernels import Own, search


def play_thread(shapes: Mine) -> Callable[..., None]:
    """Return the GPU kernel that runs ``play`` in n threads. ``shapes`` of their memory are constants of its code."""
    line, car, clock, know, wanted, proposed, scratch, out, rewards, value, seen = shapes

    def play_worlds(
        stored: Any, pool: Any, following: Any, actions: Any, results: Any, rules: Any, view: Any, mode: Any, n: Any
    ) -> None:
        t = cuda.grid(1)
        if t < n:
            mine = Mine(
                cuda.local.array(line, float64),
                cuda.local.array(car, float64),
                cuda.local.array(clock, float64),
                cuda.local.array(know, float64),
                cuda.local.array(wanted, float64),
                cuda.local.array(proposed, float64),
                cuda.local.array(scratch, float64),
                cuda.local.array(out, float64),
                cuda.local.array(rewards, float64),
                cuda.local.array(value, float64),
                cuda.local.array(seen, float32),
            )
            play(t, mine, stored, pool, following, actions, results, rules, view, mode)

    return play_worlds


def search_thread(shapes: Own) -> Callable[..., None]:
    """Return the GPU kernel that runs ``search`` in n threads. ``shapes`` of their memory are constants of its code."""
    car, clock, wanted, bounds, shares, at, scratch, lines, tried = shapes[:9]
    commands, best_commands, change, ends, best_ends, kind, random = shapes[9:]

    def search_worlds(searched: Any, plans: Any, drawing: Any, drawn: Any, budget: Any, n: Any) -> None:
        t = cuda.grid(1)
        if t < n:
            own = Own(
                cuda.local.array(car, float64),
                cuda.local.array(clock, float64),
                cuda.local.array(wanted, float64),
                cuda.local.array(bounds, float64),
                cuda.local.array(shares, float64),
                cuda.local.array(at, float64),
                cuda.local.array(scratch, float64),
                cuda.local.array(lines, float64),
                cuda.local.array(tried, float64),
                cuda.local.array(commands, float64),
                cuda.local.array(best_commands, float64),
                cuda.local.array(change, float64),
                cuda.local.array(ends, int64),
                cuda.local.array(best_ends, int64),
                cuda.local.array(kind, int64),
                cuda.local.array(random, uint64),
            )
            search(t, own, searched, plans, drawing, drawn, budget)

    return search_worlds
