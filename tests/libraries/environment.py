"""One cached virtual environment for each library, with this project in it as it stands."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.libraries.library import ROOT, Library

ENVIRONMENTS = ROOT / ".venvs"
TORCH = "torch==2.13.0"  # as constraints.txt; without a number an index may offer another one, of gigabytes
NO_NETWORK = ("dns error", "error sending request", "failed to fetch", "could not connect", "timed out", "network")


class NotInstalled(Exception):
    """The environment of a library cannot be made; the message says why in one line."""


def ready_python(name: str, library: Library) -> Path:
    """The interpreter of the library's environment, made if it is not there yet; raises ``NotInstalled``."""
    folder = ENVIRONMENTS / name
    python, stamp = folder / "bin" / "python", folder / ".installed"
    wanted = _fingerprint(library)
    if stamp.is_file() and stamp.read_text("utf-8") == wanted:
        return python
    uv = find_uv()
    call_uv([uv, "venv", "--quiet", "--clear", "--python", sys.executable, str(folder)])
    install = [uv, "pip", "install", "--quiet", "--python", str(python)]
    install_torch(install)
    overrides = folder / "overrides.txt"
    overrides.write_text(TORCH, "utf-8")
    call_uv([*install, "--override", str(overrides), "-e", str(ROOT), TORCH, *library.requires])
    stamp.write_text(wanted, "utf-8")
    return python


def _fingerprint(library: Library) -> str:
    """Of all that decides what is in the environment."""
    told = (sys.version, str(ROOT), TORCH, library.requires, (ROOT / "pyproject.toml").read_text())
    return hashlib.sha256(repr(told).encode()).hexdigest()


def find_uv() -> str:
    beside = Path(sys.executable).parent / "uv"
    found = str(beside) if beside.is_file() else shutil.which("uv")
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
    given = {"UV_HTTP_TIMEOUT": "60", "UV_HTTP_RETRIES": "1", **os.environ}
    if "PIP_FIND_LINKS" in given:
        given.setdefault("UV_FIND_LINKS", ",".join(given["PIP_FIND_LINKS"].split()))
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return
    told = " ".join(done.stderr.split())
    if any(word in told.lower() for word in NO_NETWORK):
        raise NotInstalled("the package index cannot be reached")
    _, _, reason = told.rpartition("we can conclude that your requirements")
    raise NotInstalled(f"does not resolve: {((reason and told) or told)[:300]}")
