"""Lazy imports: the ``__init__`` of a folder lists public names; a name is imported at its first use.

The list is a block of imports under ``if TYPE_CHECKING``, which type checkers understand. This module reads the list
from the compiled code of the ``__init__``: a zip file, or a program made by PyInstaller, has no source file.
"""

from __future__ import annotations

import dis
import sys
from collections.abc import Callable
from importlib import import_module
from itertools import dropwhile
from typing import Any

BLOCK = "LOAD_NAME", "TYPE_CHECKING"  # the instruction before the block


def names_behind(package: str) -> dict[str, str]:
    """Public name -> module that defines it, from the ``if TYPE_CHECKING`` block of the package's ``__init__``."""
    code = sys.modules[package].__spec__.loader.get_code(package)  # type: ignore[union-attr]  # every loader has it
    names, home = dict[str, str](), ""
    for each in dropwhile(lambda each: (each.opname, each.argval) != BLOCK, dis.get_instructions(code)):
        if each.opname == "IMPORT_NAME":
            home = each.argval
        elif each.opname == "IMPORT_FROM":
            names[each.argval] = home
    return names


def front_door(package: str) -> Callable[[str], Any]:
    """Set ``__all__`` and ``__dir__`` of a package; return its ``__getattr__``, which imports a name at its first use.

    ``package`` is the ``__name__`` of the package's ``__init__``.
    """
    folder, names = sys.modules[package], names_behind(package)
    vars(folder).update(__all__=[*names], __dir__=lambda: sorted({*vars(folder), *names}))

    def import_name(name: str) -> Any:
        home = names.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(home), name)

    return import_name
