"""PTX of a kernel (code that NVIDIA's driver compiles for its GPU): made without a GPU, and stored in the cache.

Multiplications and additions are not fused (``fma=0``), so every operation rounds as on a processor, and a world has
the same bits on both.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import naming_extras
from ethbrake_marl.kernel_cache import load_data, save_data
from ethbrake_marl.motion.compiling import stamp_of

NEWEST = (9, 0)  # GPUs that are newer run the code of this one
PTX_VERSION = "8.4"  # every driver from 550 on reads it, and nothing here needs a newer one


def ptx_of(
    name: str, kernel: Callable[[], Callable[..., None]], arguments: tuple[Any, ...], capability: tuple[int, int]
) -> str:
    """PTX of a kernel, compiled for the types of ``arguments``; its entry point has the name "kernel".

    The code is read from the cache if it is stored there. ``name``: key of the code in the cache; it must contain
    everything that decides the code, except the sources. ``kernel``: function that makes the kernel, called only if the
    code is not stored. ``capability``: the GPU's compute capability. Raises ``MissingExtra`` if the code must be
    compiled and numba-cuda is not installed.
    """
    capability = min(capability, NEWEST)
    stamp = stamp_of(str(Path(__file__).with_name("threads.py")))
    file = f"{name}-{capability[0]}{capability[1]}-{stamp[:32]}"
    code: str | None = load_data(file, bytes.decode)
    if code is None:
        code = compile_kernel(kernel(), arguments, capability)
        save_data(file, code.encode())
    return code


def compile_kernel(kernel: Callable[..., None], arguments: tuple[Any, ...], capability: tuple[int, int]) -> str:
    """PTX of a kernel for the types of ``arguments``, with the entry point "kernel".

    Raises ``MissingExtra`` if numba-cuda is not installed.
    """
    with naming_extras():
        import numba_cuda  # noqa: F401  # replaces numba.cuda
    import numba
    from numba import cuda

    with without_fma(capability):
        types = numba.void(*(numba.typeof(argument) for argument in arguments))
        text, _ = cuda.compile_ptx(kernel, types, cc=capability)
    text = re.sub(r"\.version \d+\.\d+", f".version {PTX_VERSION}", text, count=1)
    entry = re.search(r"\.entry (\w+)\(", text)
    assert entry is not None
    return text.replace(entry[1], "kernel")


@contextmanager
def without_fma(capability: tuple[int, int]) -> Iterator[None]:
    """Context manager in which numba-cuda does not fuse * and +, and compiles without a GPU.

    Two functions of numba-cuda are replaced, because it has no option for either.
    """
    from numba.cuda import dispatcher
    from numba.cuda.cudadrv import nvvm

    class Gpu:
        compute_capability = capability

    before = nvvm.compile_ir, dispatcher.get_current_device
    nvvm.compile_ir = lambda code, **options: before[0](code, **options | {"fma": 0})
    dispatcher.get_current_device = lambda: Gpu
    try:
        yield
    finally:
        nvvm.compile_ir, dispatcher.get_current_device = before
