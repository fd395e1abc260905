"""Train policies with PPO and SAC of Stable-Baselines3: recipes, runs, exact resume."""
