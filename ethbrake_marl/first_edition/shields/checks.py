"""Checks of a shield's arguments: numbers such as the allowance, and the scenario."""

from __future__ import annotations

from numbers import Real

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.scenario.schema import Scenario


def is_amount(value: object, below: float = np.inf) -> bool:
    """Return whether ``value`` is a number (not True or False) of at least 0 and less than ``below``."""
    return isinstance(value, Real) and not isinstance(value, bool) and 0.0 <= float(value) < below


def check_amount(name: str, value: object, where: str, unit: str = "") -> None:
    """Raise ``InvalidInput`` unless ``value``, the value of the setting ``name``, is a finite number of at least 0.

    The error message begins with ``where`` and ends with ``unit``, such as " m2/s2".
    """
    if not is_amount(value):
        raise InvalidInput(f"{where}: {name} = {value!r}: must be a finite number of at least 0{unit}")


def check_scenario(scenario: object, where: str) -> None:
    """Raise ``InvalidInput`` unless ``scenario`` is a ``Scenario`` (not a name). The message begins with ``where``."""
    if not isinstance(scenario, Scenario):
        raise InvalidInput(f"{where}: scenario = {scenario!r}: must be a Scenario; eb.load_scenario(name) loads one")
