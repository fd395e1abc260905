"""The GPU kernel: each thread allocates its own memory, and calls ``kernels.play_world``.

numba's simulator runs it without a GPU. This module is imported only when needed, because numba.cuda is slow to import.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import cuda, float32, float64

from ethbrake_marl.extensions.cuda.kernels import ThreadMemory, play_world


def play_thread(shapes: ThreadMemory) -> Callable[..., None]:
    """GPU kernel that runs ``play_world`` in n threads.

    ``shapes``: shapes of the arrays in a thread's memory; they are constants of the kernel's code.
    """
    line, car, clock, know, wanted, proposed, scratch, out, rewards, value, shape_of_observations = shapes

    def play_worlds(
        stored: Any, pool: Any, following: Any, actions: Any, results: Any, settings: Any, view: Any, mode: Any, n: Any
    ) -> None:
        t = cuda.grid(1)
        if t < n:
            memory = ThreadMemory(
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
                cuda.local.array(shape_of_observations, float32),
            )
            play_world(t, memory, stored, pool, following, actions, results, settings, view, mode)

    return play_worlds
