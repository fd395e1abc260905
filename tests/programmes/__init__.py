"""What asks more than a test may take. ``python -m tests.programmes`` lists the programmes.

Environments of other libraries and other versions are made by uv below ``.venvs/`` and kept for the next time.
"""

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".venvs"
TORCH = "torch==2.13.0"  # as constraints.txt; without a number an index may offer another one, of gigabytes
NO_NETWORK = ("dns error", "error sending request", "failed to fetch", "could not connect", "timed out", "network")


class Told(NamedTuple):
    """How a case ended: whether it was good (None: nothing is claimed), and one line about it."""

    good: bool | None
    text: str = ""


Cases = Iterator[tuple[str, Callable[[], Told]]]
Given = argparse.Namespace


# ---------------------------------------------------------------- environments


class NotInstalled(Exception):
    """An environment cannot be made; the message says why in one line."""


def ready_python(
    name: str, requires: Sequence[str], overrides: Sequence[str] = (), *, project: bool = True, torch: bool = True
) -> Path:
    """The interpreter of an environment that holds ``requires``, made if it is not there; raises ``NotInstalled``.

    ``overrides``: what these require, whatever they say. ``project``: this project too, as it stands.
    """
    folder = KEPT / name
    python, stamp = folder / "bin" / "python", folder / ".installed"
    told = (sys.version, str(ROOT), TORCH, requires, overrides, project, torch, (ROOT / "pyproject.toml").read_text())
    wanted = hashlib.sha256(repr(told).encode()).hexdigest()
    if stamp.is_file() and stamp.read_text("utf-8") == wanted:
        return python
    install = new_environment(python, sys.executable)
    own = ["-e", str(ROOT)] if project else []
    if torch:
        install_torch(install)
        (folder / "overrides.txt").write_text("\n".join([TORCH, *overrides]), "utf-8")
        own += [TORCH, "--override", str(folder / "overrides.txt")]
    call_uv([*install, *own, *requires])
    stamp.write_text(wanted, "utf-8")
    return python


def new_environment(python: Path, base: str) -> list[str]:
    """Make the environment whose interpreter is to be ``python``; the begin of a command that installs into it."""
    uv = find_uv()
    call_uv([uv, "venv", "--quiet", "--clear", "--python", base, str(python.parents[1])])
    return [uv, "pip", "install", "--quiet", "--python", str(python)]


def find_uv() -> str:
    found = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if found is None:
        raise NotInstalled("uv is missing (`pip install uv`): it keeps what was downloaded, and links it")
    return found


def install_torch(install: list[str]) -> None:
    """The build for this machine from where torch publishes them; where that is out of reach, what the index has."""
    own = [] if os.environ.get("UV_FIND_LINKS") or os.environ.get("PIP_FIND_LINKS") else ["--torch-backend", "auto"]
    try:
        call_uv([*install, *own, "--no-deps", TORCH])
    except NotInstalled:
        if not own:
            raise
        call_uv([*install, "--no-deps", TORCH])


def call_uv(command: list[str]) -> None:
    """Run uv where pip's own settings hold too; raises ``NotInstalled`` with the line that says what is wrong."""
    given = {"UV_HTTP_TIMEOUT": "60", "UV_HTTP_RETRIES": "1", "UV_PYTHON_DOWNLOADS": "never", **os.environ}
    if "PIP_FIND_LINKS" in given:
        given.setdefault("UV_FIND_LINKS", ",".join(given["PIP_FIND_LINKS"].split()))
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return
    told = " ".join(done.stderr.split())
    if any(word in told.lower() for word in NO_NETWORK):
        raise NotInstalled("the package index cannot be reached")
    raise NotInstalled(f"does not resolve: {told[:300]}")


def watched(command: Sequence[str], limit: float, **variables: str) -> tuple[int | None, str]:
    """Exit status (None: not done after ``limit`` seconds) and output of a command; what it started ends with it."""
    given = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    with subprocess.Popen(
        command, cwd=ROOT, env=given, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL, start_new_session=True,
    ) as begun:  # fmt: skip
        try:
            told, _ = begun.communicate(timeout=None if limit == float("inf") else max(limit, 0.0))
        except subprocess.TimeoutExpired:
            return None, ""
        finally:
            if begun.poll() is None:
                os.killpg(begun.pid, signal.SIGKILL)
    return begun.returncode, told
