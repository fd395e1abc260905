"""What functions and classes of the package use: found by importing all its modules, not from a list.

A node is a function (compiled or not) or a class. It uses the nodes whose names stand in its code.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

import ethbrake_marl
from ethbrake_marl.errors import MissingExtra

PREFIX = "ethbrake_marl."
# The plain game itself: how vehicles move, one step of an episode, and the worlds that are drawn for it.
MOTION = ("motion.interval:", "motion.contact:", "motion.impact:", "motion.push:", "episode.step:")
GAME = ("motion.", "episode.step:", "episode.game:Game", "worlds.sampling:")


@cache
def modules() -> dict[str, ModuleType]:
    """All modules of the package that can be imported here, by name, without the program (``__main__``)."""
    found = {}
    for info in pkgutil.walk_packages(ethbrake_marl.__path__, PREFIX):
        if info.name.endswith("__main__"):  # who runs it later would be warned that it has been imported
            continue
        try:
            found[info.name] = importlib.import_module(info.name)
        except (MissingExtra, ModuleNotFoundError):
            continue
    return found


def function_of(node: Any) -> Any:
    return inspect.unwrap(getattr(node, "py_func", node))


@cache
def nodes() -> dict[int, tuple[str, Any]]:
    """Identity of each node -> its place, such as ``episode.hold:choose``, and the node."""
    return {
        id(value): (f"{name}:{key}".removeprefix(PREFIX), value)
        for name, module in modules().items()
        for key, value in vars(module).items()
        if isinstance(function_of(value), FunctionType | type) and function_of(value).__module__ == name
    }


def codes(node: Any) -> Iterator[CodeType]:
    if isinstance(node, type):
        for part in list(vars(node).values()):
            method = getattr(part, "__func__", getattr(part, "fget", getattr(part, "func", part)))
            if isinstance(function_of(method), FunctionType):
                yield from codes(method)
        return
    unread = [function_of(node).__code__]
    while unread:
        code = unread.pop()
        unread += [value for value in code.co_consts if isinstance(value, CodeType)]
        yield code


@cache
def used_by(identity: int) -> frozenset[int]:
    _place, node = nodes()[identity]
    scope, found = vars(modules()[function_of(node).__module__]), list(node.__bases__) if isinstance(node, type) else []
    for code in codes(node):
        values = [scope.get(name) for name in code.co_names]
        imported = [value for value in values if isinstance(value, ModuleType)]
        imported += [modules()[name] for name in code.co_names if name in modules()]  # inside the function
        found += values + [vars(module).get(name) for module in imported for name in code.co_names]
    return frozenset(id(value) for value in found if id(value) in nodes()) - {identity}


@cache
def reached_from(identity: int) -> frozenset[int]:
    """Nodes that a node uses, also through others, but not through the plain game."""
    found, unread = set(used_by(identity)), list(used_by(identity))
    while unread:
        identity = unread.pop()
        if not nodes()[identity][0].startswith(GAME):
            unread += used_by(identity) - found
            found |= used_by(identity)
    return frozenset(found)


@cache
def predictors() -> frozenset[int]:
    """Nodes outside the plain game that compute motion: by its kernels, or by steps of an episode."""
    engine = {
        identity
        for identity, (place, node) in nodes().items()
        if place.startswith(MOTION) and isinstance(function_of(node), FunctionType)
    }
    return frozenset(
        identity
        for identity, (place, _node) in nodes().items()
        if not place.startswith(GAME) and reached_from(identity) & engine
    )


@cache
def users() -> dict[int, set[int]]:
    found: dict[int, set[int]] = {}
    for identity in nodes():
        for used in used_by(identity):
            found.setdefault(used, set()).add(identity)
    return found


def needed_arguments(node: Any) -> set[str]:
    """Names of the arguments without a default of a function that is not compiled; empty for any other node."""
    if isinstance(node, type) or hasattr(node, "py_func"):
        return set()
    return {
        name
        for name, parameter in inspect.signature(node).parameters.items()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
    }
