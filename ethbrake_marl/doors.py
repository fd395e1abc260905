"""Front doors: a folder's ``__init__`` lists what other folders use of it, and imports each name on first use.

The list is a table of imports under ``if TYPE_CHECKING``. Type checkers read it as imports; at run time it is read from
the file, so that what a caller does not use (torch, matplotlib, scipy) is not loaded.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


@cache
def names_behind(file: str) -> dict[str, str]:
    """Name -> the module that it lives in, as the table in an ``__init__`` file says."""
    content = ast.parse(Path(file).read_text("utf-8")).body
    table = next(part for part in content if isinstance(part, ast.If)).body
    lines = [line for line in table if isinstance(line, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in lines for alias in line.names}


def front_door(package: str, file: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a folder. It raises ``AttributeError`` for what the folder's table does not name."""
    folder, names = sys.modules[package], names_behind(file)
    vars(folder).update(__all__=[*names], __dir__=lambda: sorted({*vars(folder), *names}))

    def import_name(name: str) -> Any:
        home = names.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(home), name)

    return import_name
