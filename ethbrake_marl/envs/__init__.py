"""Environments: PettingZoo (parallel, AEC), Gymnasium, Gymnasium vector and SB3 ``VecEnv``; and ``render()``."""
