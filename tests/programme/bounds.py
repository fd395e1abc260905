"""The tests at the lowest versions that ``pyproject.toml`` allows, and at the newest that resolve.

``make test-bounds`` (or ``python -m tests.programme.bounds [KIND ...] [--python PATH ...] [--tests PATH ...] [--ci]``)
makes one environment below ``.venvs/`` for each kind and each Python, and prints one line for each:

- ``lowest``, ``highest``: the project with what it needs to train and to be tested; pytest runs there.
- ``lowest-light``, ``highest-light``: the core alone, without torch; the commands of ``tests.wheel`` run there.

At the lowest versions each bound of ``pyproject.toml`` must be the version that was installed: no bound is lower than
what was tried. What cannot be installed is skipped with a clear word. Exits with status 1 when something has failed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.libraries.environment import ENVIRONMENTS, TORCH, NotInstalled, call_uv, find_uv, install_torch
from tests.wheel.__main__ import calls, run

ROOT = Path(__file__).resolve().parents[2]
RESOLUTIONS = {"lowest": "lowest-direct", "highest": "highest"}
KINDS = (*RESOLUTIONS, *(f"{resolution}-light" for resolution in RESOLUTIONS))
EXTRAS = ("train", "dev")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")  # that the light kinds of --ci look for
# Each interface, the physics with its golden worlds, and what touches most of the packages.
TESTS = ("contract", "envs", "physics", "golden", "scenario", "agents", "evaluation", "files", "figures", "cli")


class NoTime(Exception):
    """Nothing failed so far, but there is no time left."""


def make_environment(kind: str, python: str) -> Path:
    """The interpreter of a new environment; raises ``NotInstalled``."""
    resolution, _, light = kind.partition("-")
    uv, there = find_uv(), ENVIRONMENTS / f"{kind}-{version_of(python)}" / "bin" / "python"
    call_uv([uv, "venv", "--quiet", "--clear", "--python", python, str(there.parents[1])])
    install = [uv, "pip", "install", "--quiet", "--python", str(there)]
    resolve = [*install, "--resolution", RESOLUTIONS[resolution], "-e"]
    if light:
        call_uv([*resolve, str(ROOT)])
    else:
        install_torch(install)
        call_uv([*resolve, f"{ROOT}[{','.join(EXTRAS)}]", TORCH])
    return there


def version_of(python: str) -> str:
    """Such as 3.11; raises ``NotInstalled`` where it is no Python."""
    ask = [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    try:
        return subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        raise NotInstalled(f"{python} cannot be run") from None


def untried_bounds(python: Path, light: bool) -> list[str]:
    """What ``pyproject.toml`` allows below the versions that are installed there; torch's number is given."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    asked = [*project["dependencies"]]
    for extra in () if light else EXTRAS:
        asked += project["optional-dependencies"][extra]
    listed = subprocess.run(
        [find_uv(), "pip", "list", "--format", "json", "--python", str(python)], capture_output=True, check=True
    )
    installed = {canonicalize_name(row["name"]): Version(row["version"]) for row in json.loads(listed.stdout)}
    found = []
    for requirement in map(Requirement, asked):
        name = canonicalize_name(requirement.name)
        for bound in requirement.specifier:
            if bound.operator == ">=" and name != "torch" and installed[name] != Version(bound.version):
                found.append(f"{requirement} allows what was not tried: {installed[name]} was installed")
    return found


def run_tests(python: Path, paths: list[str], until: float) -> tuple[bool, str]:
    """Whether pytest passed there, and its last line; raises ``NoTime``.

    Warnings that something will go from another package are no failure here: they are what other versions differ in.
    """
    calm = "ignore::DeprecationWarning"
    command = [str(python), "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-W", calm, *paths]
    caches = {"NUMBA_CACHE_DIR": str(python.parents[1] / "numba"), "PYTHONWARNINGS": calm, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, **caches},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as begun:
        try:
            told, _ = begun.communicate(timeout=None if until == float("inf") else max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            raise NoTime from None
        finally:
            if begun.poll() is None:
                os.killpg(begun.pid, signal.SIGKILL)
    lines = told.strip().splitlines()
    if begun.returncode:
        print("\n".join(line for line in lines if line.startswith(("FAILED", "ERROR", "E  "))), flush=True)
    return begun.returncode == 0, lines[-1] if lines else "no output"


def run_light(python: Path, until: float) -> tuple[bool, str]:
    """Whether all commands of the light core end as they must there, and how many; raises ``NoTime``."""
    done = []
    with tempfile.TemporaryDirectory(prefix="ethbrake-bounds-") as folder:
        for call in calls():
            if time.monotonic() >= until:
                raise NoTime
            done.append(run(call, python.parents[1], Path(folder)))
    return all(done), f"{sum(done)} of {len(done)} commands of the light core"


def attempt(kind: str, python: str, paths: list[str], until: float) -> bool:
    """Try one kind with one Python, print how it ended; false where something failed."""
    name = f"{kind}, {python}"
    try:
        if time.monotonic() >= until:
            raise NoTime
        there = make_environment(kind, python)
        light = kind.endswith("-light")
        untried = untried_bounds(there, light) if kind.startswith("lowest") else []
        print("".join(f"{line}\n" for line in untried), end="", flush=True)
        name = there.parents[1].name
        passed, told = run_light(there, until) if light else run_tests(there, paths, until)
    except NotInstalled as reason:
        print(f"skipped {name}: {reason}", flush=True)
        return True
    except NoTime:
        print(f"skipped {name}: no time left", flush=True)
        return True
    good = passed and not untried
    print(f"{'ok     ' if good else 'FAILED '} {name}: {told}", flush=True)
    return good


def find_python(version: str) -> str:
    """An interpreter of that version on the search path or kept by pyenv; raises ``NotInstalled``."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions").glob(f"{version}.*/bin/python")
    for candidate in (shutil.which(f"python{version}"), *map(str, sorted(kept))):
        try:
            if candidate and version_of(candidate) == version:
                return candidate
        except NotInstalled:
            continue
    raise NotInstalled("not on this machine")


def of_ci() -> list[tuple[str, str]]:
    """Kinds and Pythons of continuous integration: the core with every Python found, the tests with this one.

    The tests at the lowest versions come first, as time may end: nobody uses those by chance, as most do the newest.
    """
    chosen = []
    for version in PYTHONS:
        try:
            chosen += [(kind, find_python(version)) for kind in KINDS if kind.endswith("-light")]
        except NotInstalled as reason:
            print(f"skipped Python {version}: {reason}", flush=True)
    return [("lowest", sys.executable), *chosen, ("highest", sys.executable)]


def main() -> int:
    """Try each kind with each Python."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; default: all")
    parser.add_argument("--python", action="append", help="an interpreter, may be given often; default: this one")
    parser.add_argument("--tests", nargs="+", default=[f"tests/{room}" for room in TESTS])
    parser.add_argument("--ci", action="store_true", help="the light core with every Python found, the rest with this")
    parser.add_argument("--within", type=float, default=float("inf"), help="seconds for all of it")
    given = parser.parse_args()
    for unknown in set(given.kinds) - set(KINDS):
        parser.error(f"{unknown}: no such kind; there are {', '.join(KINDS)}")
    until = time.monotonic() + given.within
    pythons = given.python or [sys.executable]
    chosen = of_ci() if given.ci else [(kind, python) for python in pythons for kind in given.kinds or KINDS]
    good = [attempt(kind, python, given.tests, until) for kind, python in chosen]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
