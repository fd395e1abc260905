"""Lazy imports for a folder: its ``__init__`` lists the names that other folders use, each imported on first use.

The list is a block of imports under ``if TYPE_CHECKING``. Type checkers read it as imports. At run time it is read from
the source file, so packages that a caller does not need (torch, matplotlib, scipy) are not loaded.
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
    """Return name -> module for every import in the ``if TYPE_CHECKING`` block of an ``__init__``.

    ``file``: path of the ``__init__`` file.
    """
    content = ast.parse(Path(file).read_text("utf-8")).body
    table = next(part for part in content if isinstance(part, ast.If)).body
    lines = [line for line in table if isinstance(line, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in lines for alias in line.names}


def front_door(package: str, file: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a folder's ``__init__``, and set the folder's ``__all__`` and ``__dir__``.

    The returned function raises ``AttributeError`` for a name that the folder's list does not contain.

    Args:
        package: the folder's ``__name__``.
        file: the folder's ``__file__``.

    """
    folder, names = sys.modules[package], names_behind(file)
    vars(folder).update(__all__=[*names], __dir__=lambda: sorted({*vars(folder), *names}))

    def import_name(name: str) -> Any:
        home = names.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(home), name)

    return import_name
