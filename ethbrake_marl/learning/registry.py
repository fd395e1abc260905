"""The names of the learning algorithms, each with the class of its recipes and the algorithm itself.

An entry of the package is a string ``module:attribute``, imported when it is first used.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ethbrake_marl.errors import InvalidInput, unknown_name

if TYPE_CHECKING:
    from pydantic import BaseModel

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_PLACE = "ethbrake_marl.learning.algorithms"


@dataclass(frozen=True, slots=True)
class _Entry:
    recipe: str | type[Any]
    algorithm: str | Any


_ENTRIES: dict[str, _Entry] = {
    "ppo": _Entry(f"{_PLACE}.ppo:PpoRecipe", f"{_PLACE}.ppo:Ppo"),
    "sac": _Entry(f"{_PLACE}.sac:SacRecipe", f"{_PLACE}.sac:Sac"),
    "counterfactual": _Entry(
        f"{_PLACE}.counterfactual:CounterfactualRecipe", f"{_PLACE}.counterfactual:Counterfactual"
    ),
}


def register_algorithm(name: str, recipe: type[BaseModel], algorithm: type[Any]) -> None:
    """Make ``algorithm: name`` a recipe that can be read, trained, stopped and resumed.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        recipe: the class of its recipes, made from ``learning.recipe.TrainingRecipe``; it checks the YAML file.
        algorithm: the class of the algorithm, made from ``learning.algorithms.protocol.Algorithm``.

    Raises ``InvalidInput`` for a name that is taken or is no such name, or a class that lacks what is needed.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"algorithm {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if name in _ENTRIES:
        raise InvalidInput(f"algorithm {name!r}: is registered already; give another name")
    for what, given, needed in (("recipe", recipe, "network_spec"), ("algorithm", algorithm, "build")):
        if not (isinstance(given, type) and hasattr(given, needed)):
            raise InvalidInput(f"algorithm {name!r}: {what} = {given!r:.80}: must be a class with {needed}")
    _ENTRIES[name] = _Entry(recipe, algorithm)


def algorithm_names() -> tuple[str, ...]:
    """Every registered name, the package's own first."""
    return tuple(_ENTRIES)


def recipe_class(name: str) -> Any:
    """The class of the recipes of an algorithm; raises ``UnknownName``."""
    return _import(_entry(name).recipe)


def algorithm_named(name: str) -> Any:
    """The algorithm of this name, new; raises ``UnknownName``."""
    return _import(_entry(name).algorithm)()


def _entry(name: str) -> _Entry:
    if name not in _ENTRIES:
        raise unknown_name("algorithm", name, _ENTRIES)
    return _ENTRIES[name]


def _import(entry: str | Any) -> Any:
    if not isinstance(entry, str):
        return entry
    module, _, attribute = entry.partition(":")
    return getattr(import_module(module), attribute)
