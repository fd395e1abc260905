"""Many trainings or worlds: ``ethbrake study sweep``, ``tune`` and ``falsify``."""
