"""The game for other people's libraries: PettingZoo, Gymnasium, Gymnasium's vector environments, Stable-Baselines3."""
