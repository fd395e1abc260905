"""What a solver proves of the code is proven, and is not proven of code with a bug."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_proofs__every_statement_and_every_planted_bug() -> None:
    pytest.importorskip("z3")
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    call = [sys.executable, "-m", "tests.proofs"]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    told = done.stdout.splitlines()
    assert sum("proven along" in line for line in told) == 8
    assert told[-1] == "planted bugs: 19 of 19 leave their statement unproven"


def test_proofs__refuse_compiled_functions() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    call = [sys.executable, "-m", "tests.proofs"]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "compilation must be switched off" in done.stderr
