"""Train policies, and go on with a training. torch and Stable-Baselines3 are imported where a training begins."""
