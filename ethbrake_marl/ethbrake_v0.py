"""PettingZoo's module: ``from ethbrake_marl import ethbrake_v0``, then ``ethbrake_v0.parallel_env()`` or ``.env()``."""

from __future__ import annotations

from ethbrake_marl.envs.pettingzoo import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
