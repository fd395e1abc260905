"""The long programme: ``make test-physics``. One line per gate; exit status 1 when one fails."""

from __future__ import annotations

import argparse
import sys
import time

from tests.physics.programme import contacts, instants, invariants, obstacles, sameness
from tests.physics.programme.gates import GATES

PARTS = (invariants, contacts, obstacles, instants, sameness)  # importing a part enters its gates


def main() -> int:
    """Measure every gate and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="only gates whose name contains this")
    given = parser.parse_args()
    failed, begin = 0, time.monotonic()
    for name, measure in GATES.items():
        if given.only not in name:
            continue
        start = time.monotonic()
        figure = measure()
        failed += not figure.good
        verdict, seconds = "PASS" if figure.good else "FAIL", time.monotonic() - start
        measured = f"{figure.value:<10.3g} <= {figure.threshold:<8.3g}"
        print(f"{verdict}  {name:58s} {measured} {seconds:6.1f} s  {figure.of}", flush=True)
    print(f"{'FAIL' if failed else 'PASS'}: {failed} gates failed, {(time.monotonic() - begin) / 60:.1f} min")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
