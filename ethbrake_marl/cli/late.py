"""Imports that wait until a command is called: numba, numpy, scipy and the engine take seconds, ``--help`` needs none.

A module of commands writes them as any others, but below ``if TYPE_CHECKING or LATE:``. Type checkers read them there;
when a command of the module is called, ``import_late`` makes them, as if they stood at its beginning.
"""

from __future__ import annotations

import ast
import importlib
import sys
from functools import cache
from pathlib import Path

LATE = False  # marks these imports; never true


@cache
def import_late(name: str) -> None:
    """Make the late imports of the module of this name, once."""
    module = sys.modules[name]
    for part in ast.parse(Path(str(module.__file__)).read_text("utf-8")).body:
        if isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING or LATE":
            for line in part.body:
                _import(line, vars(module))


def _import(line: ast.stmt, into: dict[str, object]) -> None:
    """One line ``from module import names``, or ``import module as name``."""
    if isinstance(line, ast.ImportFrom):
        found = importlib.import_module(str(line.module))
        for each in line.names:
            if not hasattr(found, each.name):  # a module of the package
                importlib.import_module(f"{line.module}.{each.name}")
            into[each.asname or each.name] = getattr(found, each.name)
    elif isinstance(line, ast.Import):
        into |= {each.asname or each.name: importlib.import_module(each.name) for each in line.names}
    else:
        raise SyntaxError(f"line {line.lineno}: below 'if TYPE_CHECKING or LATE' stand imports alone")
