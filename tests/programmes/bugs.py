"""Planted bugs that some test must find: errors that people make in such code. They are in ``bugs.yaml``.

Each bug is planted in a copy of the repository. There run the tests in the folder of the changed file, and if none of
them fails, all tests.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from queue import SimpleQueue
from typing import NamedTuple

import yaml

from ethbrake_marl.motion.digest import physics_digest
from tests.programmes import ROOT, Cases, Given, Told

PACKAGE = "ethbrake_marl"
DIGEST = "motion/digest.py"
BUGS = Path(__file__).with_name("bugs.yaml")
NOT_COPIED = (".git", ".venv", ".venvs", "runs", "build", "dist", "_build", "__pycache__", ".*_cache", ".hypothesis")
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--tb=no")
LIMIT_S = 1800.0  # a bug whose tests do not end is found
SOUND = "without a bug, no test fails"
OPTIONS = {"--jobs": {"type": int, "default": 2, "help": "number of bugs at once"}}


class Bug(NamedTuple):
    """Changes of files of the package: file, old text (which occurs exactly once), new text."""

    name: str
    patches: list[tuple[str, str, str]]


def planted() -> list[Bug]:
    """Bugs of ``bugs.yaml``."""
    return [Bug(name, patches) for name, patches in yaml.safe_load(BUGS.read_text("utf-8")).items()]


def misfits() -> list[str]:
    """Patches whose old text is not in its file exactly once."""
    found = []
    for name, patches in planted():
        for file, old, _ in patches:
            count = (ROOT / PACKAGE / file).read_text("utf-8").count(old)
            if count != 1:
                found.append(f"{name}: {file} contains {old!r} {count} times")
    return found


def near(file: str) -> list[str]:
    """Tests of the folder of a file of the package: those to run first."""
    folder = PurePosixPath("tests") / PurePosixPath(file).parent
    return [str(folder)] if folder.name != "tests" else [str(p.relative_to(ROOT)) for p in ROOT.glob("tests/test_*.py")]


def cases(given: Given) -> Cases:
    """Yield all planted bugs with the test that finds each."""
    bugs = [] if given.list else [bug for bug in [Bug(SOUND, []), *planted()] if given.only in bug.name]
    with tempfile.TemporaryDirectory(prefix="bugs-") as folder, ThreadPoolExecutor(given.jobs) as pool:
        copies = SimpleQueue[Path]()
        for number in range(given.jobs if bugs else 0):
            copies.put(copy_of_the_repository(Path(folder) / str(number)))
        tried = {bug.name: pool.submit(finder, bug, copies) for bug in bugs}
        yield "each old text is in its file exactly once", lambda: Told(not misfits(), "; ".join(misfits()))
        yield SOUND, lambda: Told(not tried[SOUND].result(), tried[SOUND].result())
        for bug in planted():
            yield bug.name, partial(lambda name: told(tried[name].result()), bug.name)


def told(test: str) -> Told:
    return Told(bool(test), test or "no test finds it")


def copy_of_the_repository(folder: Path) -> Path:
    """Copy what the tests need, with the times of its files, which numba compares."""
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
    return folder


def finder(bug: Bug, copies: SimpleQueue[Path]) -> str:
    """First test that fails with a bug; empty if none fails."""
    copy = copies.get()
    try:
        with changed(bug, copy):
            first = near(bug.patches[0][0]) if bug.patches else []
            return (first and failing(copy, first)) or failing(copy, ["tests", *(f"--ignore={each}" for each in first)])
    finally:
        copies.put(copy)


@contextmanager
def changed(bug: Bug, copy: Path) -> Iterator[None]:
    """Context manager: the copy has the bug inside the block.

    Its digest of the physics stays that of the repository, so that tables and proofs do not give a bug away.
    """
    files = {file: copy / PACKAGE / file for file in {DIGEST, *(file for file, _, _ in bug.patches)}}
    try:
        for file, old, new in bug.patches:
            files[file].write_text(files[file].read_text("utf-8").replace(old, new), "utf-8")
        with files[DIGEST].open("a", encoding="utf-8") as source:
            source.write(f"\n\ndef physics_digest() -> str:\n    return {physics_digest()!r}\n")
        yield
    finally:
        for file, path in files.items():
            shutil.copy2(ROOT / PACKAGE / file, path)


def failing(copy: Path, tests: list[str]) -> str:
    """First of these tests that fails in a copy; empty if all pass."""
    kernels = copy.with_name(f"{copy.name}-kernels")
    variables = {"PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(kernels), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-B", *PYTEST, *tests]
    try:
        done = subprocess.run(
            command, cwd=copy, env={**os.environ, **variables}, capture_output=True, text=True, check=False,
            timeout=LIMIT_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "(the tests do not end)"
    if done.returncode in (0, 5):  # 5: no tests are there
        return ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return failed[1] if failed else f"(pytest exits with status {done.returncode})"
