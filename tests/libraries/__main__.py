"""Other people's libraries on this environment: ``make test-libraries`` (``python -m tests.libraries [NAME ...]``).

Each library gets an environment of its own in ``.venvs/``, kept for the next run, with this project as it stands. Its
file of this folder is run there: every way in which its user trains. Prints the matrix, then the policies that were
kept in one table, and exits with status 1 where something failed; what cannot be installed is skipped, and the reason
told. ``--write`` keeps the rows in ``matrix.json``, and writes docs/other-libraries.md from them and from the files.
``--ci`` takes the libraries that are cheap to install.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.libraries.environment import ENVIRONMENTS, NotInstalled, ready_python
from tests.libraries.library import NAMES, ROOT, load
from tests.libraries.one_table import FILES, make_table
from tests.libraries.page import COLUMNS, PAGE, TABLE_HEADS, cells, make_page, read_matrix, table_cells, write_matrix

NO_TIME = "skipped: no time left"


def main() -> None:
    """Run what is asked for, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; default: all")
    parser.add_argument("--ci", action="store_true", help="only the libraries that are cheap to install")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for one library")
    parser.add_argument("--within", type=float, default=float("inf"), help="seconds for all of them")
    parser.add_argument("--write", action="store_true", help="write the matrix and docs/other-libraries.md")
    parser.add_argument("--page", action="store_true", help="run nothing, write the page from the last matrix")
    given = parser.parse_args()
    if given.page:
        PAGE.write_text(make_page(), "utf-8")
        return
    for unknown in set(given.names) - set(NAMES):
        parser.error(f"{unknown}: no such library; there are {', '.join(NAMES)}")
    names = [n for n in given.names or NAMES if load(n).in_ci or not given.ci]
    until = time.monotonic() + given.within
    rows = {name: run(name, given.limit, until) for name in names}
    show(COLUMNS, [cells(row) for name in names for row in rows[name]])
    table = policies_of_all() if set(FILES) & set(names) else []
    if given.write:
        write_matrix({**read_matrix(), **rows, **({"one_table": table} if table else {})})
        PAGE.write_text(make_page(), "utf-8")
    sys.exit(1 if any("FAILED" in row["verdict"] for name in names for row in rows[name]) else 0)


def show(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table."""
    widths = [max(len(row[c]) for row in [heads, *rows]) for c in range(len(heads))]
    for row in [heads, *rows]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip(), flush=True)


def policies_of_all() -> list[dict[str, Any]]:
    """The policies that four libraries left, in one table; none while one of them has not run yet."""
    missing = [name for name, file in FILES.items() if not file.is_file()]
    if missing:
        print(f"no table of all policies yet: run {', '.join(missing)}", flush=True)
        return []
    try:
        rows = make_table(ready_python("benchmarl", load("benchmarl")))
    except NotInstalled as reason:
        print(f"no table of all policies: {reason}", flush=True)
        return []
    show(TABLE_HEADS, [table_cells(row) for row in rows])
    return rows


def run(name: str, limit: float, until: float) -> list[dict[str, Any]]:
    """The rows of one library, for at most ``limit`` seconds, and not beyond ``until`` on the monotonic clock."""
    library = load(name)
    row: dict[str, Any] = {"library": library.title, "version": "", "way": "", "ran": ""}
    if time.monotonic() >= until:
        return [row | {"verdict": NO_TIME}]
    try:
        python = ready_python(name, library)
    except NotInstalled as reason:
        print(f"== {library.title}: skipped: {reason}", flush=True)
        return [row | {"verdict": f"skipped: {reason}"}]
    folder = ENVIRONMENTS / "work" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    file = folder / "rows.json"
    left = until - time.monotonic()
    command = [str(python), "-W", "ignore", "-m", "tests.libraries.measure", name, str(file)]
    timed_out, status = watch(command, max(min(limit, left), 0.0))
    rows: list[dict[str, Any]] = json.loads(file.read_text("utf-8")) if file.is_file() else []
    if len(rows) < len(library.ways):
        why = f"FAILED: not done after {limit:.0f} s" if timed_out else f"FAILED: ended with status {status}"
        verdict = NO_TIME if timed_out and left < limit else why
        rows.append(row | {"way": library.ways[len(rows)].title, "verdict": verdict})
    return rows


def watch(command: list[str], limit: float) -> tuple[bool, int]:
    """Run the command in the folder of its last argument for at most ``limit`` seconds, and end all that it started."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    given = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", **threads}
    given["MINARI_DATASETS_PATH"] = str(Path(command[-1]).parent)  # not among the data sets of whoever runs this
    begun = subprocess.Popen(command, cwd=Path(command[-1]).parent, env=given, start_new_session=True)
    try:
        return False, begun.wait(limit)
    except subprocess.TimeoutExpired:
        return True, -1
    finally:
        if begun.poll() is None:
            os.killpg(begun.pid, signal.SIGKILL)
            begun.wait()


if __name__ == "__main__":
    main()
