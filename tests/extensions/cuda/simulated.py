"""Whole episodes in numba's simulator of a GPU, which runs the threads in Python and does not clear their memory.

``NUMBA_ENABLE_CUDASIM=1 NUMBA_DISABLE_JIT=1 python -m tests.extensions.cuda.simulated 2`` drives two worlds of each
scenario, and compares the bits with the core.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from numba import cuda

from ethbrake_marl.extensions.cuda.device import Kernel, as_arrays
from tests.extensions.cuda.test_worlds import SIX, whole_episodes


def launch(kernel: Kernel, on: torch.device, n: int, *given: Any) -> None:
    cuda.jit(kernel.thread())[-(-n // 2), 2](*as_arrays(given), n)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", type=int, help="worlds of each scenario")
    given = parser.parse_args()
    Kernel.launch = launch  # type: ignore[method-assign]
    for name in SIX.values():
        print(name, whole_episodes(name, given.worlds))
