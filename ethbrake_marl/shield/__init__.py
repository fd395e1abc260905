"""Shields: what stands between a proposed action and the applied one."""

from ethbrake_marl.shield.episode import HybridAgent
from ethbrake_marl.shield.parallel import HybridShield

__all__ = ["HybridAgent", "HybridShield"]
