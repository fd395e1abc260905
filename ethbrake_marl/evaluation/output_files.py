"""Where results go: nothing is overwritten by accident, and a file is there whole or not at all."""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.durable_files import write_file
from ethbrake_marl.errors import AlreadyExists, InvalidInput


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Refuse a file that exists (``AlreadyExists``, unless ``force``) or has no folder (``InvalidInput``).

    Call it before long work whose result goes there.
    """
    target = Path(path)
    if target.is_dir():
        raise InvalidInput(f"{target}: is a folder; give the name of a file")
    if not target.parent.is_dir():
        raise InvalidInput(f"{target}: there is no folder {target.parent}; make it first")
    if target.exists() and not force:
        raise AlreadyExists(f"{target}: is there already; give another name or use force (--force)")
    return target


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` in one step; raises as ``check_target``."""
    write_file(check_target(path, force=force), data)
