"""Environment module in PettingZoo's style: ``parallel_env()``, and ``env()`` for the AEC interface."""

from __future__ import annotations

from ethbrake_marl.faces.pettingzoo import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
