"""How kernels are compiled, and where their machine code is kept.

A kernel is a function on arrays of numbers, compiled by numba. Kernels use + - * / sqrt, min, max and comparisons only,
without fast-math: a world has the same bits in every batch and on every processor.

Numba keeps the machine code of a function, and does not notice when a function that it calls changes. The folder of the
machine code is therefore named by the digest of the core's kernels and of all kernels beside it.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]
SOURCES = ("motion", "episode")  # folders with the core's kernels
_MARK = b"motion.compiling import"  # in every other file with kernels
LEAST_FREE_BYTES = 50_000_000
TEMPORARY = "ethbrake_marl-"


def _compile(function: Function, **options: Any) -> Function:
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder_of(function.__code__.co_filename))
    try:
        compiled: Function = numba.njit(
            cache=True, nogil=True, error_model="numpy", boundscheck=False, _nrt=False, **options
        )(function)
    finally:
        config.CACHE_DIR = before
    return compiled


def kernel(function: Function) -> Function:
    """Compile a function that becomes a part of every kernel that calls it."""
    return _compile(function, forceinline=True)


def large(function: Function) -> Function:
    """Compile a function once for all its callers, among them Python."""
    return _compile(function)


@cache
def folder_of(file: str) -> Path:
    """Return the folder with the machine code of the kernels in ``file``, which may call those of the files beside it.

    If the user's cache cannot be written, or its disk is full, this is a temporary folder, to which machine code that
    may only be read (a container's image) is copied. Warns if there is none to copy.
    """
    digest = hashlib.sha256()
    beside = {path for path in Path(file).parent.glob("*.py") if _MARK in path.read_bytes()}
    core = {path for name in SOURCES for path in (PACKAGE / name).glob("*.py")}
    for path in sorted({Path(file)} | beside | core):
        digest.update(path.name.encode() + path.read_bytes())
    kept, temporary = cache_home() / digest.hexdigest()[:16], _temporary() / digest.hexdigest()[:16]
    if _has_room(kept):
        return kept
    try:
        if _is_ours(kept) and any(kept.iterdir()):
            shutil.copytree(kept, temporary, dirs_exist_ok=True)
            return temporary
    except OSError:
        pass
    _warn_once()
    return temporary


@cache
def _warn_once() -> None:
    warnings.warn(
        f"{cache_home()}: cannot be written, or its disk is full, so every process compiles the physics again (20 s);"
        " set NUMBA_CACHE_DIR to a folder that can be written",
        stacklevel=2,
    )


@cache
def cache_home() -> Path:
    """Return the folder for the machine code of this package, under ``$NUMBA_CACHE_DIR`` or the user's cache."""
    try:
        root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no HOME, and the user id has no name
        return _temporary()
    return Path(root) / "ethbrake_marl"


def _has_room(folder: Path) -> bool:
    """Return whether this user can write into a folder, which nobody else can have filled, and the disk is not full."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return _is_ours(folder) and shutil.disk_usage(folder).free >= LEAST_FREE_BYTES
    except OSError:
        return False


def _is_ours(folder: Path) -> bool:
    """Return whether this user or root owns a folder: its machine code will be run."""
    return not hasattr(os, "getuid") or folder.stat().st_uid in (0, os.getuid())


@cache
def _temporary() -> Path:
    folder = Path(tempfile.gettempdir()) / f"{TEMPORARY}{os.getpid()}-{os.urandom(4).hex()}"
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
