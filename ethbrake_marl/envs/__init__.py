"""Environments for each interface: PettingZoo (parallel, AEC), Gymnasium, Gymnasium vector, SB3 ``VecEnv``;
``render()``.
"""
