"""The tests at the lowest versions that ``pyproject.toml`` allows, and at the newest that resolve.

``make test-bounds`` (or ``python -m tests.programme.bounds [lowest highest] [--python PATH] [--tests PATH ...]``)
makes one environment below ``.venvs/`` for each resolution and each Python, installs the project with what it needs to
train and to be tested, and runs pytest there. Prints one line for each. What cannot be installed is skipped with a
clear word. Exits with status 1 when tests have failed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from tests.libraries.environment import ENVIRONMENTS, TORCH, NotInstalled, call_uv, find_uv, install_torch

ROOT = Path(__file__).resolve().parents[2]
RESOLUTIONS = {"lowest": "lowest-direct", "highest": "highest"}
# Each interface, the physics with its golden worlds, and what touches most of the packages.
TESTS = ("contract", "envs", "physics", "golden", "scenario", "agents", "evaluation", "files", "figures", "cli")


def make_environment(resolution: str, python: str) -> Path:
    """The interpreter of a new environment; raises ``NotInstalled``."""
    version = subprocess.run([python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], capture_output=True)
    name = f"{resolution}-{version.stdout.decode().strip() or Path(python).name}"
    uv, there = find_uv(), ENVIRONMENTS / name / "bin" / "python"
    call_uv([uv, "venv", "--quiet", "--clear", "--python", python, str(ENVIRONMENTS / name)])
    install = [uv, "pip", "install", "--quiet", "--python", str(there)]
    install_torch(install)
    call_uv([*install, "--resolution", RESOLUTIONS[resolution], "-e", f"{ROOT}[train,dev]", TORCH])
    return there


def run_tests(python: Path, paths: list[str]) -> tuple[bool, str]:
    """Whether pytest passed there, and its last line.

    Warnings that something will go from another package are no failure here: they are what other versions differ in.
    """
    calm = "ignore::DeprecationWarning"
    command = [str(python), "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-W", calm, *paths]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONWARNINGS": calm}, capture_output=True, text=True)
    lines = (done.stdout + done.stderr).strip().splitlines()
    if done.returncode:
        print("\n".join(line for line in lines if line.startswith(("FAILED", "ERROR", "E  "))), flush=True)
    return done.returncode == 0, lines[-1] if lines else "no output"


def main() -> int:
    """Try each resolution with each Python."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("resolutions", nargs="*", choices=[*RESOLUTIONS, []], default=list(RESOLUTIONS))
    parser.add_argument("--python", action="append", help="an interpreter, may be given often; default: this one")
    parser.add_argument("--tests", nargs="+", default=[f"tests/{room}" for room in TESTS])
    given = parser.parse_args()
    good = True
    for python in given.python or [sys.executable]:
        for resolution in given.resolutions:
            try:
                there = make_environment(resolution, python)
            except NotInstalled as reason:
                print(f"skipped {resolution}, {python}: {reason}", flush=True)
                continue
            passed, told = run_tests(there, given.tests)
            print(f"{'ok     ' if passed else 'FAILED '} {there.parent.parent.name}: {told}", flush=True)
            good = good and passed
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
