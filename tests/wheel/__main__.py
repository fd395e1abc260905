"""The wheel alone in an empty environment: how large it is, and that all of the core runs there without torch.

Then the sdist in the wheel's place: it must bring the same files, and pass a smoke test. ``make test-light`` (or
``python -m tests.wheel [--environment FOLDER]``) prints one line for each thing tried: ok or FAILED, seconds, what; and
exits with status 1 when one has failed. ``--environment`` names an environment to install into instead of a new one;
its packages stay.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.wheel.reproducible import build

ROOT = Path(__file__).resolve().parents[2]
LIMIT_MB = 650
NOT_OURS = ("pip", "setuptools", "pkg_resources", "wheel", "_distutils_hack")  # what an empty environment begins with
NAME = "ethbrake-marl"
SHIPPED = "ppo@shipped,ppo@shipped+episode"
NEEDS_TRAIN = "-m pip install 'ethbrake-marl[train]'"


@dataclass(frozen=True)
class Call:
    """A command in the environment, the status it must end with, and the end of what it then says on stderr."""

    arguments: tuple[str, ...]
    status: int = 0
    error: str = ""


COMMANDS = (
    Call(("ethbrake", "--version")),
    Call(("ethbrake", "evaluate", "--agents", SHIPPED, "--episodes", "200")),
    Call(("ethbrake", "evaluate", "--agents", "full_brake,ppo@shipped+step", "--episodes", "20", "--json")),
    Call(("ethbrake", "shield", "--agents", "ppo@shipped", "--episodes", "20")),
    Call(("ethbrake", "watch", "picture", "deceleration", "--output", "deceleration.png")),
    Call(("ethbrake", "watch", "picture", "shield-modes", "--episodes", "20", "--output", "modes.png")),
    Call(("ethbrake", "scenario", "validate", "paper-random")),
    Call(("ethbrake", "doctor")),
    Call(("ethbrake", "train", "--steps", "1000"), 2, NEEDS_TRAIN),
    Call(("ethbrake", "run"), 2, NEEDS_TRAIN),
    Call(("ethbrake", "doctor", "speed", "--quick"), 2, NEEDS_TRAIN),
    Call(("ethbrake", "agent", "export", "shipped/ppo", "--onnx", "ppo.onnx"), 2, "'ethbrake-marl[export]'"),
    Call(("python", "-c", "import ethbrake_marl as eb; eb.train")),
)


SMOKE = (COMMANDS[0], COMMANDS[1], COMMANDS[6], COMMANDS[7])  # of the sdist, whose files are the wheel's


def readme_example() -> str:
    """The first Python program of the README."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    assert found is not None
    return found[1]


def calls() -> Iterator[Call]:
    """Everything that is tried, in order."""
    yield Call(("python", "-c", readme_example()))
    interfaces = "eb.env(), eb.parallel_env(), eb.EthBrakeEnv(), eb.EthBrakeVectorEnv(4)"
    absent = "assert not {'torch', 'stable_baselines3', 'tensorboard'} & set(sys.modules)"
    yield Call(("python", "-W", "error", "-c", f"import sys, ethbrake_marl as eb; {interfaces}; {absent}"))
    yield from COMMANDS[:-1]
    yield Call(COMMANDS[-1].arguments, 1, NEEDS_TRAIN)  # in Python: an exception, whose last line says it


def prepare(environment: Path, folder: Path) -> tuple[Path, Path]:
    """Make the environment and build wheel and sdist into ``folder``; the two files."""
    if not (environment / "bin" / "python").exists():
        venv.create(environment, with_pip=True)
    build(folder)
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


def install(environment: Path, file: Path) -> set[tuple[str, str]]:
    """Install a wheel or sdist at the versions of constraints.txt; path and hash of each of its files."""
    pip = [str(environment / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    constraints = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, *constraints, "--force-reinstall", "--no-deps", str(file)], check=True)
    subprocess.run([*pip, *constraints, str(file)], check=True)
    (record,) = environment.glob(f"lib/python*/site-packages/{NAME.replace('-', '_')}-*.dist-info/RECORD")
    rows = [line.rsplit(",", 2) for line in record.read_text("utf-8").splitlines()]
    return {(path, digest) for path, digest, _ in rows if path.startswith("ethbrake_marl/") and digest}


def installed_mb(environment: Path) -> float:
    """Size of what was installed, 10^6 bytes: files of site-packages but those of an empty environment."""
    (packages,) = environment.glob("lib/python*/site-packages")
    parts = [part for part in packages.iterdir() if not part.name.startswith(NOT_OURS)]
    files = [file for part in parts for file in ([part] if part.is_file() else part.rglob("*"))]
    return sum(file.lstat().st_size for file in files if file.is_file()) / 1e6


def run(call: Call, environment: Path, folder: Path) -> bool:
    """Run one command in an empty folder, and say how it ended."""
    program, *arguments = call.arguments
    given = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_CACHE_DIR": str(folder / "cache")}
    given.pop("PYTHONPATH", None)
    begun = time.monotonic()
    done = subprocess.run(
        [str(environment / "bin" / program), *arguments],
        env=given,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    last = (done.stderr.strip().splitlines() or [""])[-1]
    ok = done.returncode == call.status and call.error in last
    shown = " ".join(call.arguments).strip().replace("\n", "; ")
    print(f"{'ok    ' if ok else 'FAILED'}  {time.monotonic() - begun:6.1f} s  {shown:.100}", flush=True)
    if not ok:
        print(f"        status {done.returncode}; {done.stdout[-500:]}{done.stderr[-1500:]}", flush=True)
    return ok


def main() -> None:
    """Install, weigh, and try everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--environment", type=Path, help="environment to install into; default: a new one, removed")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ethbrake-wheel-") as temporary:
        folder = Path(temporary)
        environment = given.environment.absolute() if given.environment else folder / "environment"
        (folder / "built").mkdir()
        wheel, sdist = prepare(environment, folder / "built")
        files = install(environment, wheel)
        size = installed_mb(environment)
        ended = [told(size <= LIMIT_MB, f"{size:.0f} MB installed; at most {LIMIT_MB}")]
        (folder / "work").mkdir()
        ended += [run(call, environment, folder / "work") for call in calls()]
        again = install(environment, sdist)
        ended.append(told(bool(files) and files == again, f"the sdist brings the wheel's {len(files)} files"))
        ended += [
            run(call, environment, folder / "work") for call in (Call(("python", "-c", readme_example())), *SMOKE)
        ]
    sys.exit(0 if all(ended) else 1)


def told(ok: bool, what: str) -> bool:
    """Print one line that is not about a command."""
    print(f"{'ok    ' if ok else 'FAILED'}  {what}", flush=True)
    return ok


if __name__ == "__main__":
    main()
