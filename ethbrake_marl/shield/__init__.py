"""Shields: what stands between a proposed action and the applied one."""

from ethbrake_marl.shield.certify import Backup, Decision, Running, certify
from ethbrake_marl.shield.episode import HybridAgent
from ethbrake_marl.shield.guard import StepShield
from ethbrake_marl.shield.parallel import HybridShield, shielded_aec
from ethbrake_marl.shield.single import ShieldedEnv
from ethbrake_marl.shield.step import StepShieldAgent

__all__ = [
    "Backup",
    "Decision",
    "HybridAgent",
    "HybridShield",
    "Running",
    "ShieldedEnv",
    "StepShield",
    "StepShieldAgent",
    "certify",
    "shielded_aec",
]
