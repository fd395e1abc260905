"""``NUMBA_DISABLE_JIT=1 python -m tests.proofs``: prove every statement, and fail to with every planted bug.

Exit status 1 if a statement is not proven, or a bug does not matter.
"""

from __future__ import annotations

import os
import sys
import time


def main() -> int:
    """Print one line for each statement."""
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        sys.exit("compilation must be switched off: NUMBA_DISABLE_JIT=1 python -m tests.proofs")
    from tests.proofs.bugs import BUGS, misses
    from tests.proofs.statements import STATEMENTS

    failed = 0
    for text, statement in STATEMENTS.items():
        begun = time.process_time()
        try:
            told = f"proven along {statement()} paths"
        except AssertionError as error:
            told, failed = f"NOT PROVEN: {error}", failed + 1
        print(f"{text}: {told} ({time.process_time() - begun:.1f} s)", flush=True)
    missed = misses()
    print(f"planted bugs: {len(BUGS) - len(missed)} of {len(BUGS)} leave their statement unproven")
    for name in missed:
        print(f"MISSED: {name}")
    return 1 if failed or missed else 0


if __name__ == "__main__":
    sys.exit(main())
