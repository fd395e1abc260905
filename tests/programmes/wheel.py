"""The packages: two builds of wheel and sdist give the same bytes, and the wheel works without torch.

``built`` writes wheel and sdist to ``--output`` if two builds have the same SHA-256. ``light`` installs the wheel in an
empty environment, checks its size, and runs the commands that must work without torch. Then it installs the sdist,
which must install the same files.
"""

import hashlib
import os
import re
import subprocess
import tempfile
import venv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tests.programmes import ROOT, Cases, Given, Told, find_uv

LIMIT_MB = 650
NOT_OURS = ("pip", "setuptools", "pkg_resources", "wheel", "_distutils_hack")  # packages of an empty environment
SHIPPED = "ppo,ppo+episode"
NEEDS_TRAIN = "-m pip install 'ethbrake-marl[train]'"


OPTIONS = {"--output": {"type": Path, "default": ROOT / "dist", "help": "folder for wheel and sdist"}}


def cases(given: Given) -> Cases:
    yield "built twice: wheel and sdist", partial(built_twice, given.output)
    with tempfile.TemporaryDirectory(prefix="ethbrake-wheel-") as folder:
        yield from light(Path(folder))


def build(folder: Path) -> dict[str, bytes]:
    """Build wheel and sdist into ``folder`` with uv. Return the content of each file by name."""
    subprocess.run([find_uv(), "build", "--quiet", "--out-dir", str(folder), str(ROOT)], check=True)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in (".whl", ".gz")}


def built_twice(output: Path) -> Told:
    """Build twice, compare the builds, and save the second."""
    with tempfile.TemporaryDirectory(prefix="ethbrake-dist-") as first, tempfile.TemporaryDirectory() as second:
        files, again = build(Path(first)), build(Path(second))
    if files != again or len(files) != 2:
        return Told(False, "two builds differ")
    output.mkdir(exist_ok=True)
    for name, content in again.items():
        (output / name).write_bytes(content)
        print(f"{hashlib.sha256(content).hexdigest()}  {name}", flush=True)
    return Told(True, "the same bytes")


# ---------------------------------------------------------------- the wheel alone


class Call(NamedTuple):
    """A command in the environment, its expected exit status, and the expected end of its message on stderr."""

    arguments: tuple[str, ...]
    status: int = 0
    error: str = ""

    @property
    def shown(self) -> str:
        return f"{' '.join(self.arguments).strip().replace(chr(10), '; '):.100}"


COMMANDS = (
    Call(("ethbrake", "--version")),
    Call(("ethbrake", "evaluate", "--agents", SHIPPED, "--episodes", "200")),
    Call(("ethbrake", "evaluate", "--agents", "full_brake,ppo+step", "--episodes", "20", "--json")),
    Call(("ethbrake", "watch", "--output", "film.png")),
    Call(("ethbrake", "scenario", "validate", "paper-random")),
    Call(("ethbrake", "doctor")),
    Call(("ethbrake", "train", "--steps", "1000"), 2, NEEDS_TRAIN),
    Call(("ethbrake", "run"), 2, NEEDS_TRAIN),
    Call(("python", "-c", "import ethbrake_marl as eb; eb.train"), 1, NEEDS_TRAIN),  # an exception ends with it
)
SMOKE = (COMMANDS[0], COMMANDS[1], COMMANDS[6], COMMANDS[7])  # for the sdist, which has the same files as the wheel
INTERFACES = "eb.env(), eb.parallel_env(), eb.EthBrakeEnv(), eb.EthBrakeVectorEnv(4)"
ABSENT = "assert not {'torch', 'stable_baselines3', 'tensorboard'} & set(sys.modules)"


def first_program() -> Call:
    """First Python program of the page on environments as a call."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "environments.md").read_text("utf-8"), re.DOTALL)
    return Call(("python", "-c", found[1]))


def calls() -> Iterator[Call]:
    """Yield all commands that are tried with the light core, in order."""
    yield first_program()
    yield Call(("python", "-W", "error", "-c", f"import sys, ethbrake_marl as eb; {INTERFACES}; {ABSENT}"))
    yield from COMMANDS


def run(call: Call, environment: Path, folder: Path) -> Told:
    """Run one command in an empty folder, and check how it ends."""
    program, *arguments = call.arguments
    given = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_CACHE_DIR": str(folder / "cache")}
    given.pop("PYTHONPATH", None)
    command = [str(environment / "bin" / program), *arguments]
    done = subprocess.run(command, env=given, cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    last = (done.stderr.strip().splitlines() or [""])[-1]
    good = done.returncode == call.status and call.error in last
    return Told(good, "" if good else f"status {done.returncode}; {done.stdout[-500:]}{done.stderr[-1500:]}")


def light(folder: Path) -> Cases:
    """Yield the cases: install the wheel, check its size, run all commands; then install the sdist."""
    there = folder / "environment"
    files: set[tuple[str, str]] = set()

    def size() -> Told:
        venv.create(there, with_pip=True)
        (folder / "work").mkdir()
        build(folder / "built")
        files.update(install(there, *folder.glob("built/*.whl")))
        found = installed_mb(there)
        return Told(found <= LIMIT_MB, f"{found:.0f} MB, at most {LIMIT_MB}")

    def same() -> Told:
        again = install(there, *folder.glob("built/*.tar.gz"))
        return Told(bool(files) and files == again, f"the wheel's {len(files)} files")

    yield "light: what is installed", size
    yield from ((f"light: {call.shown}", partial(run, call, there, folder / "work")) for call in calls())
    yield "light: what the sdist brings", same
    for call in (first_program(), *SMOKE):
        yield f"light, from the sdist: {call.shown}", partial(run, call, there, folder / "work")


def install(environment: Path, file: Path) -> set[tuple[str, str]]:
    """Install a wheel or sdist at the versions of constraints.txt. Return path and hash of each of its files."""
    pip = [str(environment / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    constraints = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, *constraints, "--force-reinstall", "--no-deps", str(file)], check=True)
    subprocess.run([*pip, *constraints, str(file)], check=True)
    (record,) = environment.glob("lib/python*/site-packages/ethbrake_marl-*.dist-info/RECORD")
    rows = [line.rsplit(",", 2) for line in record.read_text("utf-8").splitlines()]
    return {(path, digest) for path, digest, _ in rows if path.startswith("ethbrake_marl/") and digest}


def installed_mb(environment: Path) -> float:
    """Size of the installed packages in MB (10^6 bytes), without those of an empty environment."""
    (packages,) = environment.glob("lib/python*/site-packages")
    parts = [part for part in packages.iterdir() if not part.name.startswith(NOT_OURS)]
    files = [file for part in parts for file in ([part] if part.is_file() else part.rglob("*"))]
    return sum(file.lstat().st_size for file in files if file.is_file()) / 1e6
