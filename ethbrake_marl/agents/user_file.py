"""An agent from a Python file of the user's: ``my_file.py:make_agent``, loaded only where a person names it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plugins import load_function, note_file


def make_from_file(argument: str | None, settings: AgentSettings) -> Driver:
    """What the function of the file makes, from the argument (or None) and the settings, or from nothing.

    A function without parameters takes neither argument nor policy: ``InvalidInput`` says so, and what is wrong with
    the file.
    """
    named = parse_spec(settings.spec).file
    assert named is not None
    function = load_function(*named)
    if settings.policy is not None:
        note_file(settings.policy)
    if not _takes_nothing(function):
        made: Driver = function(argument, settings)
        return made
    if (argument, settings.policy) != (None, None):
        raise InvalidInput(f"agent {settings.spec!r}: {named[1]} has no parameters, so it takes no argument")
    made = function()
    return made


def _takes_nothing(function: Callable[..., Any]) -> bool:
    try:
        return not inspect.signature(function).parameters
    except (TypeError, ValueError):  # of something built in
        return False
