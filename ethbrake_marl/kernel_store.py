"""The cache folder of compiled physics code, and functions to call before the first compilation. Imports no numba."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

LEAST_FREE_BYTES = 50_000_000
_TEMPORARY = "ethbrake_marl-"
_tellers: list[Callable[[Path, bool], None]] = []


def home_folder() -> Path | None:
    """Return this package's folder in ``$NUMBA_CACHE_DIR`` or the user's cache; None without a home folder."""
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "ethbrake_marl"


@cache
def cache_folder() -> Path:
    """Return the folder of the compiled code.

    It is a temporary folder if ``home_folder`` cannot be written to, has no space, or belongs to another user.
    """
    folder = home_folder()
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                if can_be_trusted(folder) and shutil.disk_usage(folder).free >= LEAST_FREE_BYTES:
                    return folder
    except OSError:
        pass
    temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return temporary


def can_be_trusted(folder: Path) -> bool:
    """Return whether this user or root owns a folder, since machine code from it will be run."""
    return not hasattr(os, "getuid") or folder.stat().st_uid in (0, os.getuid())


def is_temporary(folder: Path) -> bool:
    return folder.name.startswith(_TEMPORARY)


def on_first_compilation(tell: Callable[[Path, bool], None]) -> None:
    """Call ``tell(folder, is_empty)`` once, just before this process compiles for the first time.

    ``is_empty``: the cache ``folder`` contains no compiled code yet.
    """
    _tellers.append(tell)


def tell_compilation() -> None:
    while _tellers:
        _tellers.pop()(cache_folder(), not any(cache_folder().rglob("*.nbi")))
