"""Copies of the repository in which bugs are planted: the working tree itself is never changed."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from tests.programme.suites import ROOT

KERNELS = "numba"  # folder of a copy: what was compiled there
PARTS = ("ethbrake_marl", "tests", "scenarios", "train", "docs")
_KEPT = ROOT / ".pytest_cache" / "copies"


def copy_repository(folder: Path) -> Path:
    """What the tests need, in ``folder``, with the times of the files."""
    ignore = shutil.ignore_patterns("__pycache__", ".venv", "runs", ".git", "*.pyc")
    for name in PARTS:
        shutil.copytree(ROOT / name, folder / name, ignore=ignore)
    shutil.copy2(ROOT / "pyproject.toml", folder / "pyproject.toml")
    return folder


@contextmanager
def working_copy() -> Iterator[Path]:
    """A copy as the repository is now, for nobody else at the same time.

    Its kernels stay for the next one, apart from the user's.
    """
    _KEPT.mkdir(parents=True, exist_ok=True)
    for number in itertools.count():
        try:
            lock = FileLock(_KEPT / f"{number}.lock").acquire(blocking=False)
        except Timeout:
            continue
        with lock:
            folder = _KEPT / str(number)
            for name in PARTS:
                shutil.rmtree(folder / name, ignore_errors=True)
            yield copy_repository(folder)
            return


@contextmanager
def mutated(folder: Path, file: str, source: str) -> Iterator[None]:
    """While it lasts ``file`` holds ``source``; then the copy is whole again, what was compiled of it included."""
    kernels = folder / KERNELS / "ethbrake_marl"
    before = set(kernels.iterdir()) if kernels.is_dir() else None
    try:
        (folder / file).write_text(source, "utf-8")
        yield
    finally:
        shutil.copy2(ROOT / file, folder / file)
        if before is not None:
            for other in set(kernels.iterdir()) - before:
                other.unlink(missing_ok=True)
