"""Infos of a shield: the keys, and their values before anything is decided."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.physics import Floats
from ethbrake_marl.shield.step_shield import StepShield


class SharesTold:
    """What each vehicle bears under the plans of a shield, for infos: found once in each step, if anybody asks."""

    def __init__(self) -> None:
        self._last: tuple[StepShield, Floats] | None = None

    def told(self, shield: StepShield, k: int, vehicle: int) -> dict[str, Any]:
        """The keys of one vehicle in world ``k``."""
        if self._last is None or self._last[0] is not shield:
            self._last = shield, shield.shares()
        return {
            "own_harm": float(self._last[1][k, vehicle]),
            "baseline_own_harm": float(shield.baseline_shares[k, vehicle]),
        }


def told_before(shield: StepShield, k: int) -> dict[str, Any]:
    """What a shield says of world ``k`` where nothing is decided."""
    assert shield.running is not None
    return {
        "mode": "step" if shield.uncertainty is None else "robust",
        "proposed_action": 0.0,
        "chosen_action": 0.0,
        "intervened": False,
        "reason": "",
        "bound_harm": float(shield.bound[k]),
        "margin": 0.0,
        "trusted": not shield.distrusted[k],
        "settles": bool(shield.settles[k]),
        **({} if shield.uncertainty is None else {"members": shield.running.members}),
    }


def by_vehicle(columns: NDArray[Any], vehicles: Sequence[int]) -> NDArray[Any]:
    """What is decided, [n] of one vehicle or [n, K], with the axis of vehicles: [n, K]."""
    return columns.reshape(len(columns), len(vehicles))


def columns_of(rows: list[dict[str, Any]]) -> dict[str, NDArray[Any]]:
    """What is told of each row, one array per key."""
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
