"""Where results go: nothing is overwritten by accident, and a file is there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from ethbrake_marl.durable_files import check_writable, write_file
from ethbrake_marl.errors import AlreadyExists, InvalidInput


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Refuse a file that exists (``AlreadyExists``, unless ``force``) or cannot be written (``InvalidInput``).

    Even ``force`` replaces plain files only: no folder, device, pipe or symbolic link. Call it before long work whose
    result goes there.
    """
    target = Path(path)
    try:
        _check_place(target)
        if os.path.lexists(target) and not force:
            raise AlreadyExists(f"{target}: is there already; give another name or use force (--force)")
        check_writable(target.parent)
    except (InvalidInput, AlreadyExists):
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{target!s:.200}: cannot be written ({reason})") from None
    return target


def _check_place(target: Path) -> None:
    if target.is_symlink():
        raise InvalidInput(f"{target}: is a symbolic link; give the file it points to")
    if target.is_dir():
        raise InvalidInput(f"{target}: is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise InvalidInput(f"{target}: is a device or a pipe, not a plain file; give another name")
    if not target.parent.is_dir():
        raise InvalidInput(f"{target}: there is no folder {target.parent}; make it first")


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` in one step; raises as ``check_target``."""
    write_file(check_target(path, force=force), data)
