"""Shields: check each proposed action and replace it where it could break a promise about harm.

The folder itself can be called: ``eb.shield(env)`` puts a shield around an environment.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.shield.attach import guard_of as guard_of
    from ethbrake_marl.shield.contract import ShieldMode as ShieldMode
    from ethbrake_marl.shield.drivers import ShieldedDriver as ShieldedDriver
    from ethbrake_marl.shield.episodes import Shielded as Shielded
    from ethbrake_marl.shield.evidence import SAME_HARM as SAME_HARM, VERDICTS as VERDICTS, review as review
    from ethbrake_marl.shield.guard import MovingAtHorizon as MovingAtHorizon
    from ethbrake_marl.shield.options import ShieldOptions as ShieldOptions
    from ethbrake_marl.shield.paper_hybrid import HybridAgent as HybridAgent
    from ethbrake_marl.shield.reasons import ShieldReason as ShieldReason
    from ethbrake_marl.shield.sb3 import ShieldedVecEnv as ShieldedVecEnv
    from ethbrake_marl.shield.step import StepShield as StepShield
    from ethbrake_marl.shield.wrappers import (
        HybridShield as HybridShield,
        ShieldedEnv as ShieldedEnv,
        ShieldedVectorEnv as ShieldedVectorEnv,
        shield as shield,
        shielded_aec as shielded_aec,
    )
else:
    __getattr__ = front_door(__name__, __file__)


class _Shielding(ModuleType):
    """Class of this module: makes ``ethbrake_marl.shield`` callable, so the folder and the function share one name."""

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        from ethbrake_marl.shield.wrappers import shield

        return shield(*arguments, **settings)


sys.modules[__name__].__class__ = _Shielding
