"""The same bits on other processors: the golden tests under settings in which libraries behave as on older ones.

In each setting numpy, the C library, OpenBLAS or numba uses the instructions of another processor. ``--sample`` leaves
out the settings that compile all kernels again.
"""

import math
import sys
from functools import partial

from tests.programmes import Cases, Given, Told, watched

NUMPY = {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3"}
LIBC = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-AVX"}
BLAS = {"OPENBLAS_CORETYPE": "Nehalem"}
SETTINGS: dict[str, dict[str, str]] = {
    "numpy without AVX-512, AVX2, FMA": NUMPY,
    "C library without FMA, AVX2, AVX": LIBC,
    "OpenBLAS for Nehalem": BLAS,
    "all of these at once": {**NUMPY, **LIBC, **BLAS},
    "kernels for x86-64-v3": {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""},
    "kernels for x86-64": {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""},
}
OPTIONS = {"--sample": {"action": "store_true", "help": "skip settings that compile all kernels again"}}


def golden(setting: dict[str, str]) -> Told:
    status, told = watched([sys.executable, "-m", "pytest", "-q", "-n", "0", "tests/golden"], math.inf, **setting)
    return Told(status == 0, told.strip().rpartition("\n")[2])


def cases(given: Given) -> Cases:
    for name, setting in SETTINGS.items():
        if not (given.sample and "NUMBA_CPU_NAME" in setting):
            yield name, partial(golden, setting)
