"""The same bits on other processors: the golden tests where libraries behave as on older ones.

In each setting numpy, the C library, OpenBLAS or numba (which compiles all kernels again) uses the instructions of
another processor.
"""

import os
import subprocess
import sys

import pytest

NUMPY = {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3"}  # AVX-512, AVX2, FMA
LIBC = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-AVX"}
BLAS = {"OPENBLAS_CORETYPE": "Nehalem"}
SETTINGS: dict[str, dict[str, str]] = {
    "numpy": NUMPY,
    "C library": LIBC,
    "OpenBLAS": BLAS,
    "all of these": {**NUMPY, **LIBC, **BLAS},
    "kernels for x86-64-v3": {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""},
    "kernels for x86-64": {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""},
}


@pytest.mark.nightly
@pytest.mark.parametrize("setting", SETTINGS)
def test_golden__have_the_same_bits_on_other_processors(setting: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "tests/golden"]
    done = subprocess.run(command, env={**os.environ, **SETTINGS[setting]}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
