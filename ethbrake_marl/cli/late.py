"""Imports that wait until a command is called: numba, numpy, scipy and the engine take seconds, ``--help`` needs none.

A module of commands writes them as any others, but below ``if TYPE_CHECKING or LATE:``. Type checkers read them there;
when a command of the module is called, ``import_late`` makes them, as if they stood at its beginning.
"""

from __future__ import annotations

import ast
import sys
from functools import cache
from pathlib import Path

LATE = False  # marks these imports; never true


@cache
def import_late(name: str) -> None:
    """Make the late imports of the module of this name, once."""
    module = sys.modules[name]
    file = str(module.__file__)
    for part in ast.parse(Path(file).read_text("utf-8")).body:
        if isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING or LATE":
            exec(compile(ast.Module(part.body, []), file, "exec"), vars(module))
