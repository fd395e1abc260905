"""PettingZoo-style environment module; use as ``ethbrake_v0.parallel_env()`` or, for the AEC API, ``ethbrake_v0.env()``."""

from __future__ import annotations

from ethbrake_marl.envs.pettingzoo import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
