"""Environment module in PettingZoo's style, with ``ethbrake_v0.parallel_env()`` and, for the AEC API, ``.env()``"""

from __future__ import annotations

from ethbrake_marl.envs.pettingzoo import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
