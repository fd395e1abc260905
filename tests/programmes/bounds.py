"""Tests with the lowest versions that ``pyproject.toml`` allows, and with the newest versions.

Each kind and each Python has its own environment in ``.venvs/``:

- ``lowest``, ``highest``: the project with everything for training and tests; the tests run there.
- ``lowest-light``, ``highest-light``: only the core, without torch; the commands of the light wheel run there.

The lowest versions must equal the bounds of ``pyproject.toml``. With another Python than this one, what cannot be
installed is skipped with the reason.
"""

import json
import subprocess
import sys
import tempfile
import time
import tomllib
from functools import partial
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.programmes import (
    KEPT,
    ROOT,
    TORCH,
    Cases,
    Given,
    NotInstalled,
    Told,
    call_uv,
    find_uv,
    install_torch,
    new_environment,
    watched,
)
from tests.programmes.wheel import calls, run

RESOLUTIONS = {"lowest": "lowest-direct", "highest": "highest"}
KINDS = (*RESOLUTIONS, *(f"{resolution}-light" for resolution in RESOLUTIONS))
EXTRAS = ("train", "dev")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")  # that the light kinds of --ci look for
CALM = "ignore::DeprecationWarning"  # that something will go from another package is what other versions differ in


OPTIONS = {
    "kinds": {"nargs": "*", "metavar": "KIND", "help": f"of {', '.join(KINDS)}; default: all"},
    "--python": {"action": "append", "help": "a version that uv finds; repeatable; default: this Python"},
    "--tests": {"nargs": "+", "default": ["tests"]},
    "--ci": {"action": "store_true", "help": "the light core with every Python found, the rest with this"},
}


def cases(given: Given) -> Cases:
    assert set(given.kinds) <= set(KINDS), f"{given.kinds}: there are {', '.join(KINDS)}"
    chosen = [(kind, python) for python in given.python or [sys.executable] for kind in given.kinds or KINDS]
    if given.ci:  # time may end: the lowest come first, as nobody uses those by chance, and most use the newest
        light = [(kind, python) for python in PYTHONS for kind in KINDS if kind.endswith("-light")]
        chosen = [("lowest", sys.executable), *light, ("highest", sys.executable)]
    for kind, python in chosen:
        yield f"{kind}, {python}", partial(attempt, kind, python, given.tests, given.until)


def attempt(kind: str, python: str, paths: list[str], until: float) -> Told:
    """Try one kind with one Python."""
    light = kind.endswith("-light")
    try:
        there = make_environment(kind, python)
        untried = untried_bounds(there, light) if kind.startswith("lowest") else []
        tried = run_light(there, until) if light else run_tests(there, paths, until)
    except NotInstalled as reason:  # another Python may be missing, or too new for a package
        return Told(False if python == sys.executable else None, f"not installed: {reason}")
    return Told(False, "; ".join([*untried, tried.text])) if untried else tried


def make_environment(kind: str, python: str) -> Path:
    """Python of a new environment. Raises ``NotInstalled``, also if this machine lacks that Python."""
    resolution, _, light = kind.partition("-")
    there = KEPT / f"{kind}-{Path(python).name}" / "bin" / "python"
    install = new_environment(there, python)
    resolve = [*install, "--resolution", RESOLUTIONS[resolution], "-e"]
    if light:
        call_uv([*resolve, str(ROOT)])
    else:
        install_torch(install)
        call_uv([*resolve, f"{ROOT}[{','.join(EXTRAS)}]", TORCH])
    return there


def untried_bounds(python: Path, light: bool) -> list[str]:
    """Bounds of ``pyproject.toml`` below the installed versions. torch's version is fixed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = () if light else EXTRAS
    asked = [*project["dependencies"], *(each for extra in extras for each in project["optional-dependencies"][extra])]
    command = [find_uv(), "pip", "list", "--format", "json", "--python", str(python)]
    listed = subprocess.run(command, capture_output=True, check=True)
    installed = {canonicalize_name(row["name"]): Version(row["version"]) for row in json.loads(listed.stdout)}
    found = []
    for requirement in map(Requirement, asked):
        name = canonicalize_name(requirement.name)
        for bound in requirement.specifier:
            if bound.operator == ">=" and name != "torch" and installed[name] != Version(bound.version):
                found.append(f"{requirement} allows what was not tried: {installed[name]} was installed")
    return found


def run_tests(python: Path, paths: list[str], until: float) -> Told:
    """Check that pytest passes in the environment; the text has its last line."""
    command = [str(python), "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-W", CALM, *paths]
    caches = {"NUMBA_CACHE_DIR": str(python.parents[1] / "numba"), "PYTHONWARNINGS": CALM}
    status, told = watched(command, until - time.monotonic(), **caches)
    if status is None:
        return Told(None, "skipped: no time left")
    lines = told.strip().splitlines() or ["no output"]
    red = [line for line in lines if line.startswith(("FAILED", "ERROR", "E  "))] if status else []
    return Told(status == 0, "\n".join([lines[-1], *red]))


def run_light(python: Path, until: float) -> Told:
    """Check that all commands of the light core end as expected, and count them."""
    done = []
    with tempfile.TemporaryDirectory(prefix="ethbrake-bounds-") as folder:
        for call in calls():
            if time.monotonic() >= until:
                return Told(None, "skipped: no time left")
            done.append((call.shown, run(call, python.parents[1], Path(folder))))
    wrong = [f"\n{name}: {told.text}" for name, told in done if not told.good]
    return Told(not wrong, f"{len(done) - len(wrong)} of {len(done)} commands of the light core{''.join(wrong)}")
