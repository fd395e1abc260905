"""Compare levels of cooperation: ``ethbrake study ablate``."""
