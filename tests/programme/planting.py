"""Planting bugs: a textual patch in a temporary copy of the repository, and the first test there that turns red."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from tests.programme.copies import KERNELS, copy_repository
from tests.programme.suites import ROOT

LIMIT_S = 900.0
QUIETLY = ("-p", "no:cacheprovider", "-p", "no:randomly", "-m", "not long")  # in a fixed order, leaving nothing behind


class Patch(NamedTuple):
    """Replace ``old``, which must stand in the file exactly once, by ``new``."""

    file: str
    old: str
    new: str


def plant(folder: Path, patches: tuple[Patch, ...]) -> None:
    """Apply the patches of one bug; raises ``ValueError`` when one does not fit."""
    for patch in patches:
        file = folder / patch.file
        text = file.read_text("utf-8")
        if text.count(patch.old) != 1:
            raise ValueError(f"{patch.file}: {patch.old!r} stands there {text.count(patch.old)} times, not once")
        file.write_text(text.replace(patch.old, patch.new), "utf-8")


def first_red(folder: Path, suite: tuple[str, ...], *, compiled: bool) -> str:
    """The first test of a suite that fails in ``folder``, or an empty string."""
    switch = "0" if compiled else "1"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / KERNELS), "NUMBA_DISABLE_JIT": switch}
    command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", *QUIETLY, "--rootdir=.", *suite]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no end after {LIMIT_S:.0f} s"
    if done.returncode == 0:
        return ""
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if found is None:
        raise RuntimeError(f"the suite could not run: {done.stdout[-500:]}{done.stderr[-500:]}")
    return found.group(1)


def red_with(patches: tuple[Patch, ...], suite: tuple[str, ...], *, compiled: bool) -> str:
    """The first test of a suite that fails in a copy with these patches, or an empty string."""
    folder = Path(tempfile.mkdtemp(prefix="planted-"))
    try:
        copy_repository(folder)
        plant(folder, patches)
        return first_red(folder, suite, compiled=compiled)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def misfits(bugs: Mapping[str, tuple[Patch, ...]]) -> list[str]:
    """What is wrong with a list of bugs itself, without running anything."""
    wrong = []
    for name, patches in bugs.items():
        for patch in patches:
            file = ROOT / patch.file
            count = file.read_text("utf-8").count(patch.old) if file.is_file() else 0
            if count != 1:
                wrong.append(f"{name}: {patch.file} holds {patch.old!r} {count} times, not once")
    return wrong


def try_bugs(
    what: str, bugs: Mapping[str, tuple[Patch, ...]], quick: tuple[str, ...], whole: tuple[str, ...], *, jobs: int
) -> int:
    """The command of a list of bugs: plant each, and print which test finds it.

    Args:
        what: whose bugs, for the last line.
        bugs: name -> patches.
        quick: tests that run first, with compilation switched off; green without any bug.
        whole: tests that run, compiled, where those stay green.
        jobs: bugs at once, where the command line does not say.

    Returns the exit status: 1 where a bug was missed, a patch does not fit, or the quick tests are red anyway.

    """
    parser = argparse.ArgumentParser(description=f"Plant {what} in copies of the repository, and see them found.")
    parser.add_argument("--jobs", type=int, default=jobs)
    parser.add_argument("--only", default="", help="only bugs whose name contains this")
    parser.add_argument("--quick", action="store_true", help="only the tests that need no compilation")
    given = parser.parse_args()
    errors = misfits(bugs)
    if not errors and (red := red_with((), quick, compiled=False)):
        errors = [f"red without any bug: {red}"]
    for wrong in errors:
        print(f"ERROR  {wrong}")
    if errors:
        return 1

    def find(name: str) -> str:
        red = red_with(bugs[name], quick, compiled=False)
        return red if red or given.quick else red_with(bugs[name], whole, compiled=True)

    names = [name for name in bugs if given.only in name]
    found = 0
    with ThreadPoolExecutor(given.jobs) as pool:
        for name, red in zip(names, pool.map(find, names), strict=True):
            found += bool(red)
            print(f"{'found ' if red else 'MISSED'}  {name:55s} {red.removeprefix('tests/')}", flush=True)
    print(f"{what}: {found}/{len(names)} found: {'PASS' if found == len(names) else 'FAIL'}")
    return 0 if found == len(names) else 1
