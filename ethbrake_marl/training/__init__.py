"""Train policies, and resume trainings. torch and Stable-Baselines3 are imported only when a training starts."""
