"""The core without extensions: a copy passes the core's tests, trains, evaluates and uses the shield.

The copy has no extensions and no tests of them. ``make core`` takes about 100 s of processor
time: the first case of each parametrised test, without the tests of the installation. ``--whole`` runs all tests of the
core with all cases. ``--each`` instead deletes one extension at a time, with the extensions that use it, and runs the
tests that remain, the first case of each.
"""

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from tests.docs.layout import arrows, layers
from tests.programmes import ROOT, Cases, Given, Told

OPTIONS = {
    "--each": {"action": "store_true", "help": "delete one extension at a time, with the extensions that use it"},
    "--whole": {"action": "store_true", "help": "run all cases of all tests of the core (minutes)"},
}
COPIED = (
    *(".ci", "docs", "ethbrake_marl", "scenarios", "tests", "train"),
    *("CHANGELOG.md", "Makefile", "README.md", "pyproject.toml"),
)
APART = ("docs", "programmes")  # tests of the whole repository, not only of the core
INSTALLATION = ("test_imports.py",)  # start many processes
OF_ALL = ("extensions/test_printed.py",)  # what all extensions print together
BY_NAME = {  # uses beside imports: recipes that observe forecasts; the agent `plan`, with which a search starts
    "extensions.learners": {"extensions.forecasts"},
    "extensions.search": {"extensions.forecasts"},
}
RUN = "runs/core"
COMMANDS = {
    "trains PPO on paper-random": ("train", "--steps", "20000", "--output", RUN),
    "evaluates": ("evaluate", "--agents", f"full_brake,e_v2x_bm,ppo@{RUN}", "--episodes", "500"),
    "evaluates behind the shield": ("evaluate", "--agents", f"ppo@{RUN}+step,ppo@{RUN}+episode", "--episodes", "200"),
    "lists the agents": ("agent", "list"),
}


def cases(given: Given) -> Cases:
    with tempfile.TemporaryDirectory(prefix="ethbrake-core-") as folder:
        if given.each:
            extensions = [name for layer in layers("ethbrake_marl.extensions") for name in layer]
            for name in extensions:
                gone = users_of(name)
                yield f"without {', '.join(sorted(gone))}", partial(passes_without, gone, Path(folder) / "copy")
        else:
            copy = copy_without(None, Path(folder) / "core")
            yield "no module names an extension", partial(names_none, copy)
            for name, words in COMMANDS.items():
                yield name, partial(ended, copy, ["-m", "ethbrake_marl", *words])
            yield "the core's tests", partial(passes, copy, whole=given.whole)
        yield "processor time", used


def passes(copy: Path, *, whole: bool) -> Told:
    """Run the tests of a copy: all cases, or the first case of each test."""
    apart = APART if whole else (*APART, *INSTALLATION, *OF_ALL)
    how = ["-n", "2", "--dist", "worksteal"] if whole else ["--first-case"]
    return ended(copy, ["-m", "pytest", "-q", *how, *(f"--ignore=tests/{each}" for each in apart), "tests"])


def passes_without(gone: set[str], folder: Path) -> Told:
    """Run the tests in a copy without some extensions. All copies stand in one place, and share machine code."""
    shutil.rmtree(folder, ignore_errors=True)
    return passes(copy_without(gone, folder), whole=False)


def users_of(extension: str) -> set[str]:
    """An extension and all extensions that need it, directly or indirectly."""
    uses, gone = {each: used | BY_NAME.get(each, set()) for each, used in arrows().items()}, {f"extensions.{extension}"}
    while more := {each for each, used in uses.items() if each.startswith("extensions.") and used & gone} - gone:
        gone |= more
    return {each.removeprefix("extensions.") for each in gone}


def copy_without(extensions: Iterable[str] | None, folder: Path) -> Path:
    """Copy the repository without these extensions (None: without any)."""
    folder.mkdir()
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "_build"))
        else:
            shutil.copy(source, folder / name)
    for parent in ("ethbrake_marl/extensions", "tests/extensions"):
        for path in [parent] if extensions is None else [f"{parent}/{each}" for each in extensions]:
            shutil.rmtree(folder / path, ignore_errors=True)
    return folder


def names_none(copy: Path) -> Told:
    """Check that no file and no test of the core names a module of an extension."""
    found = [
        path.relative_to(copy).as_posix()
        for path in sorted([*(copy / "ethbrake_marl").rglob("*.py"), *(copy / "tests").rglob("test_*.py")])
        if not {*APART} & {*path.relative_to(copy).parts}
        if re.search(r"\bextensions\.[a-z]|extensions import", path.read_text("utf-8"))
    ]
    return Told(not found, ", ".join(found))


def ended(copy: Path, words: Sequence[str]) -> Told:
    """Run a Python program in the copy, and check that it ends with status 0."""
    done = subprocess.run(
        [sys.executable, *words],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = (done.stdout + done.stderr).strip().splitlines()
    return Told(done.returncode == 0, lines[-1] if done.returncode == 0 and lines else "\n".join(lines[-30:]))


def used() -> Told:
    """Report the processor time of all child processes, in seconds."""
    times = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Told(None, f"{times.ru_utime + times.ru_stime:.0f} s")
