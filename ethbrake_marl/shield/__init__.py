"""Shields: what stands between a proposed action and the applied one. Called, it puts one around an environment."""

import sys
from types import ModuleType
from typing import Any

from ethbrake_marl.shield.certify import Backup, Decision, Running, certify
from ethbrake_marl.shield.guard import HybridAgent, MovingAtHorizon, ShieldedDriver, ShieldOptions
from ethbrake_marl.shield.step_shield import StepShield
from ethbrake_marl.shield.uncertainty import Interval, Uncertainty, parse_uncertainty
from ethbrake_marl.shield.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.wrappers import shield as _shield

__all__ = [
    "Backup",
    "Decision",
    "HybridAgent",
    "HybridShield",
    "Interval",
    "MovingAtHorizon",
    "Running",
    "ShieldOptions",
    "ShieldedDriver",
    "ShieldedEnv",
    "ShieldedVectorEnv",
    "StepShield",
    "Uncertainty",
    "certify",
    "parse_uncertainty",
    "shielded_aec",
]


class _Shielding(ModuleType):
    """``eb.shield`` is this folder and the function of its name: whoever imports one has the other."""

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        return _shield(*arguments, **settings)


sys.modules[__name__].__class__ = _Shielding
