"""Programmes: checks that are too slow or too large for the tests. ``python -m tests.programmes`` lists them.

uv makes environments with other libraries and other versions in ``.venvs/``, and they stay there for the next run.
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
TORCH = "torch==2.13.0"  # as in constraints.txt; without a number an index may offer another build, of gigabytes
NO_NETWORK = ("dns error", "error sending request", "failed to fetch", "could not connect", "timed out", "network")


class Told(NamedTuple):
    """Result of a case: True (good), False (failed) or None (no verdict), and one line of text."""

    good: bool | None
    text: str = ""


Cases = Iterator[tuple[str, Callable[[], Told]]]
Given = argparse.Namespace


# ---------------------------------------------------------------- environments


class NotInstalled(Exception):
    """An environment cannot be made; the message gives the reason in one line."""


def ready_python(
    name: str, requires: Sequence[str], overrides: Sequence[str] = (), *, project: bool = True, torch: bool = True
) -> Path:
    """Python of an environment that has ``requires``. Make the environment if it does not exist.

    ``overrides``: versions that replace the requirements of these packages. ``project``: install this project, too.
    Raises ``NotInstalled``.
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
    """Make the environment of ``python``, and return the beginning of a command that installs packages into it."""
    uv = find_uv()
    call_uv([uv, "venv", "--quiet", "--clear", "--python", base, str(python.parents[1])])
    return [uv, "pip", "install", "--quiet", "--python", str(python)]


def find_uv() -> str:
    found = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if found is None:
        raise NotInstalled("uv is missing (`pip install uv`)")
    return found


def install_torch(install: list[str]) -> None:
    """Install torch's build for this machine from its own index, or the build of the usual index if that fails."""
    own = [] if os.environ.get("UV_FIND_LINKS") or os.environ.get("PIP_FIND_LINKS") else ["--torch-backend", "auto"]
    try:
        call_uv([*install, *own, "--no-deps", TORCH])
    except NotInstalled:
        if not own:
            raise
        call_uv([*install, "--no-deps", TORCH])


def call_uv(command: list[str]) -> None:
    """Run uv with pip's settings. Raise ``NotInstalled`` with the reason in one line."""
    given = {"UV_HTTP_TIMEOUT": "60", "UV_HTTP_RETRIES": "1", "UV_PYTHON_DOWNLOADS": "never", **os.environ}
    if "PIP_FIND_LINKS" in given:
        given.setdefault("UV_FIND_LINKS", ",".join(given["PIP_FIND_LINKS"].split()))
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return
    told = " ".join(done.stderr.split())
    if any(word in told.lower() for word in NO_NETWORK):
        raise NotInstalled("the package index cannot be reached")
    raise NotInstalled(f"uv cannot resolve the requirements: {told[:300]}")


def watched(command: Sequence[str], limit: float, **variables: str) -> tuple[int | None, str]:
    """Exit status (None after ``limit`` seconds) and output of a command. Its child processes end with it."""
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
