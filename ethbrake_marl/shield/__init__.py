"""Shields: what stands between a proposed action and the applied one."""

from ethbrake_marl.shield.agents import HybridAgent, ShieldedTeam, StepShieldAgent
from ethbrake_marl.shield.certify import Backup, Decision, Running, certify
from ethbrake_marl.shield.guard import MovingAtHorizon, ShieldOptions
from ethbrake_marl.shield.step_shield import Certified, StepShield
from ethbrake_marl.shield.uncertainty import Interval, Uncertainty, parse_uncertainty
from ethbrake_marl.shield.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec

__all__ = [
    "Backup",
    "Certified",
    "Decision",
    "HybridAgent",
    "HybridShield",
    "Interval",
    "MovingAtHorizon",
    "Running",
    "ShieldOptions",
    "ShieldedEnv",
    "ShieldedTeam",
    "ShieldedVectorEnv",
    "StepShield",
    "StepShieldAgent",
    "Uncertainty",
    "certify",
    "parse_uncertainty",
    "shielded_aec",
]
