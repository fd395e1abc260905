"""The game as an environment of other libraries: PettingZoo, Gymnasium (single and vector), Stable-Baselines3."""
