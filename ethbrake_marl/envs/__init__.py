"""The four faces of the environment, thin over ``engine``: PettingZoo, Gymnasium, its vector API, Stable-Baselines3."""
