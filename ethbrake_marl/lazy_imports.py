"""Lazy imports: the ``__init__`` of a folder lists public names; a name is imported at its first use.

The list is a block of imports under ``if TYPE_CHECKING``, which type checkers understand. This module reads the list
from the source file.
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
    """Public name -> module that defines it, from the ``if TYPE_CHECKING`` block of the ``__init__.py`` at ``file``."""
    statements = ast.parse(Path(file).read_text("utf-8")).body
    block = next(statement for statement in statements if isinstance(statement, ast.If)).body
    imports = [statement for statement in block if isinstance(statement, ast.ImportFrom)]
    return {alias.name: str(statement.module) for statement in imports for alias in statement.names}


def front_door(package: str, file: str) -> Callable[[str], Any]:
    """Set ``__all__`` and ``__dir__`` of a package; return its ``__getattr__``, which imports a name at its first use.

    ``package`` and ``file`` are ``__name__`` and ``__file__`` of the package's ``__init__``.
    """
    folder, names = sys.modules[package], names_behind(file)
    vars(folder).update(__all__=[*names], __dir__=lambda: sorted({*vars(folder), *names}))

    def import_name(name: str) -> Any:
        home = names.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(home), name)

    return import_name
