"""What the other vehicles will do, for agents and searches that look ahead."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.starts import Script, is_state_free

ADVICE = "; looking ahead needs full_brake, coast, constant:a, copy_leader or gentlest_front"


def fixed_commands(
    others: Mapping[int, Script],
    worlds: Worlds,
    who: str,
    *,
    vehicle: int | None = None,
    is_fixed: Callable[[Script], bool] = is_state_free,
    advice: str = ADVICE,
) -> Floats:
    """The command of every vehicle from the alert on, [n, N] m/s2; those without an entry in ``others`` brake fully.

    ``worlds`` are at the alert. ``who`` looks ahead and drives ``vehicle``, which is left out. Raises ``InvalidInput``
    (first ``who``, at its end ``advice``) for a script whose command is not fixed at the alert, as ``is_fixed`` says.
    """
    command = -worlds.vehicles.braking_capacity_mps2
    for i, script in others.items():
        if i == vehicle:
            continue
        if not is_fixed(script):
            name = getattr(script, "name", type(script).__name__)
            raise InvalidInput(
                f"{who}: vehicle_{i + 1} is driven by {name!r}, whose command is not fixed at the alert{advice}"
            )
        asked = copy.deepcopy(script)  # what it remembers of running episodes is not disturbed
        asked.begin(worlds, i, np.arange(worlds.n))
        command[:, i] = asked.act(worlds, i)
    return command
