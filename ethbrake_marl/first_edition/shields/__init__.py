"""Shields: check each proposed action and replace it where it could break a promise about harm."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.shields.attach import guard_of as guard_of
    from ethbrake_marl.first_edition.shields.contract import ShieldMode as ShieldMode
    from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver as ShieldedDriver
    from ethbrake_marl.first_edition.shields.episodes import Shielded as Shielded
    from ethbrake_marl.first_edition.shields.evidence import (
        SAME_HARM as SAME_HARM,
        VERDICTS as VERDICTS,
        review as review,
    )
    from ethbrake_marl.first_edition.shields.guard import MovingAtHorizon as MovingAtHorizon
    from ethbrake_marl.first_edition.shields.options import ShieldOptions as ShieldOptions
    from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent as HybridAgent
    from ethbrake_marl.first_edition.shields.reasons import ShieldReason as ShieldReason
    from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv as ShieldedVecEnv
    from ethbrake_marl.first_edition.shields.step import StepShield as StepShield
    from ethbrake_marl.first_edition.shields.wrappers import (
        HybridShield as HybridShield,
        ShieldedEnv as ShieldedEnv,
        ShieldedVectorEnv as ShieldedVectorEnv,
        shield as shield,
        shielded_aec as shielded_aec,
    )
else:
    __getattr__ = front_door(__name__, __file__)
