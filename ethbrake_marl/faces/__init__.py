"""The game for other libraries: PettingZoo, Gymnasium and its vector environments, Stable-Baselines3."""
