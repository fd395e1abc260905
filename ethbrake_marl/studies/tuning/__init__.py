"""Tuning: the settings of a recipe that do least harm, searched by Optuna, each trial an ordinary training."""
