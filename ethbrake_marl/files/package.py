"""The folder of this package, with the files that it ships: scenarios, recipes, policies, tables, texts."""

from __future__ import annotations

import atexit
import zipfile
from functools import cache
from importlib.resources import files
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import cast


@cache
def package_folder() -> Path:
    """A package in a zip file is unpacked into a folder that this process deletes when it ends."""
    package = files("ethbrake_marl")
    if isinstance(package, Path):
        return package.resolve()
    folder = Path(mkdtemp(prefix="ethbrake_marl-"))
    atexit.register(rmtree, folder, ignore_errors=True)
    zipped = cast(zipfile.Path, package)
    zipped.root.extractall(folder, [name for name in zipped.root.namelist() if name.startswith(zipped.at)])
    return folder / zipped.at
