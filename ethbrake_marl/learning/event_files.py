"""TensorBoard's event files as something that can be cut back to a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path


def event_sizes(folder: Path) -> dict[str, int]:
    """Name -> bytes of the event files, which must have been flushed."""
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir())} if folder.is_dir() else {}


def cut_back(folder: Path, sizes: Mapping[str, int]) -> None:
    """Drop what was written after ``event_sizes`` gave ``sizes``: later records, and later files.

    Only plain files are cut; links and pipes in their place go, folders stay.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            continue  # nothing that a training wrote
        if path.name not in sizes or path.is_symlink() or not path.is_file():
            path.unlink()  # of a link the link alone
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])
