"""The core alone: a copy without extensions passes the core's tests, trains, evaluates and shields.

It deletes ``ethbrake_marl/extensions``, ``tests/extensions``, and the entry points in ``pyproject.toml`` that lead
there. ``make core`` runs it.
"""

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tests.fixtures.installed import write_metadata
from tests.programmes import ROOT, Cases, Given, Told

COPIED = ("ethbrake_marl", "scenarios", "tests", "train", "docs", "pyproject.toml", "Makefile", "README.md")
TESTS = ("tests/engine", "tests/golden", "tests/contract", "tests/scenario", "tests/physics", "tests/shield")
RUN = "runs/core"
COMMANDS = {
    "trains PPO on paper-random": ("train", "--steps", "20000", "--output", RUN),
    "evaluates": ("evaluate", "--agents", f"full_brake,e_v2x_bm,ppo@{RUN}", "--episodes", "500"),
    "evaluates behind the shield": ("evaluate", "--agents", f"ppo@{RUN}+step,ppo@{RUN}+episode", "--episodes", "200"),
    "compares the modes of the shield": ("shield", "--agents", f"ppo@{RUN}", "--episodes", "100"),
    "names no extension in its help": ("--help",),
}


def cases(given: Given) -> Cases:
    with tempfile.TemporaryDirectory(prefix="ethbrake-core-") as folder:
        copy = copy_core(Path(folder))
        yield "no module names an extension", partial(names_none, copy)
        for name, words in COMMANDS.items():
            yield name, partial(ended, copy, ["-m", "ethbrake_marl", *words])
        tests = [each for each in TESTS if (copy / each).exists()]
        yield "the core's tests", partial(ended, copy, ["-m", "pytest", "-q", "-x", "-n", "2", *tests])
        yield "processor time", used


def copy_core(folder: Path) -> Path:
    """The tree without extensions; its metadata are those of its ``pyproject.toml``."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "_build"))
        else:
            shutil.copy(source, folder / name)
    for name in ("ethbrake_marl/extensions", "tests/extensions"):
        shutil.rmtree(folder / name, ignore_errors=True)
    project = folder / "pyproject.toml"
    text = re.sub(r'(?m)^["\w.-]+ = "ethbrake_marl\.extensions\..*"\n', "", project.read_text("utf-8"))
    project.write_text(text, "utf-8")
    write_metadata(folder, tomllib.loads(text)["project"])
    return folder


def environment(copy: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}


def names_none(copy: Path) -> Told:
    """Whether no file of the core mentions a module of an extension."""
    found = [
        path.relative_to(copy).as_posix()
        for path in sorted((copy / "ethbrake_marl").rglob("*.py"))
        if re.search(r"\bextensions\.[a-z]", path.read_text("utf-8"))
    ]
    return Told(not found, ", ".join(found))


def ended(copy: Path, words: Sequence[str]) -> Told:
    """Whether a Python program ends well in the copy."""
    done = subprocess.run(
        [sys.executable, *words], cwd=copy, env=environment(copy), capture_output=True, text=True, check=False
    )
    lines = (done.stdout + done.stderr).strip().splitlines()
    return Told(done.returncode == 0, lines[-1] if done.returncode == 0 and lines else "\n".join(lines[-30:]))


def used() -> Told:
    """Seconds of a processor that all of it took."""
    times = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Told(None, f"{times.ru_utime + times.ru_stime:.0f} s")
