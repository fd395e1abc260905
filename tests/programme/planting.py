"""Planting bugs: a textual patch in a temporary copy of the repository, and the first test there that turns red."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tests.programme.copies import KERNELS, copy_repository
from tests.programme.suites import ROOT

LIMIT_S = 900.0
QUIETLY = ("-p", "no:cacheprovider", "-p", "no:randomly")  # in a fixed order, leaving nothing behind


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
