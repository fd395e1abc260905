"""Levels of cooperation, compared: ``ethbrake study ablate``."""
