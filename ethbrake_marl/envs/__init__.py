"""The four interfaces, thin over ``engine``: PettingZoo, Gymnasium, its vector API, Stable-Baselines3."""
