"""The whole suite in random orders and in parallel: no test may need another one, its place in the order, or rest.

``make test-order`` (or ``python -m tests.programme.order [--runs 10] [--workers 2] [--seed 1] [PATH ...]``). Prints one
line for each run: what pytest counted, and for one that fails the command that repeats it and where its output stands.
Exits with status 1 when one has failed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def arguments(seed: int, workers: int, paths: list[str]) -> list[str]:
    """What pytest is called with in one run."""
    order = ["-p", "randomly", "-p", "xdist", f"--randomly-seed={seed}"]
    return ["-q", *order, "-n", str(workers), "--dist", "worksteal", *paths]


def run(seed: int, workers: int, paths: list[str]) -> bool:
    """Run the suite once, and say how it ended."""
    with tempfile.NamedTemporaryFile("w", prefix=f"order-{seed}-", suffix=".log", delete=False) as log:
        given, begin = arguments(seed, workers, paths), time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *given], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, check=False
        )
    lines = Path(log.name).read_text("utf-8").splitlines()
    counted = lines[-1] if lines else "no output"
    print(f"{'ok    ' if done.returncode == 0 else 'FAILED'}  order {seed}: {counted}", flush=True)
    if done.returncode == 0:
        Path(log.name).unlink()
        return True
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    print("\n".join([*failed, f"        pytest {' '.join(given)}", f"        {log.name}"]), flush=True)
    print(f"        after {time.monotonic() - begin:.0f} s")
    return False


def main() -> int:
    """Run as often as asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="*", help="files or folders of tests; default: all")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1, help="of the first order; the next has the next number")
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.runs)
    good = sum(run(seed, given.workers, given.paths) for seed in seeds)
    print(f"runs in random order: {good}/{given.runs} without a failure: {'PASS' if good == given.runs else 'FAIL'}")
    return 0 if good == given.runs else 1


if __name__ == "__main__":
    sys.exit(main())
