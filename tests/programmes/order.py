"""The whole suite in random orders and in parallel: no test may need another one, its place in the order, or rest.

For a run that fails, the command that repeats it is told, and where its output stands.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from tests.programmes import ROOT, Cases, Told


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("paths", nargs="*", help="files or folders of tests; default: all")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1, help="of the first order; the next has the next number")


def cases(given: argparse.Namespace) -> Cases:
    for seed in range(given.seed, given.seed + given.runs):
        order = ["-q", "-p", "randomly", "-p", "xdist", f"--randomly-seed={seed}"]
        yield f"order {seed}", partial(run, [*order, "-n", str(given.workers), "--dist", "worksteal", *given.paths])


def run(words: list[str]) -> Told:
    """Run the suite once, and say how it ended."""
    with tempfile.NamedTemporaryFile("w", prefix="order-", suffix=".log", delete=False) as log:
        command = [sys.executable, "-m", "pytest", *words]
        status = subprocess.run(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
    lines = Path(log.name).read_text("utf-8").splitlines() or ["no output"]
    if status == 0:
        Path(log.name).unlink()
        return Told(True, lines[-1])
    red = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return Told(False, "\n".join([lines[-1], *red, f"pytest {' '.join(words)}", log.name]))
