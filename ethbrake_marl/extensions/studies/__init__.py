"""Studies of many trainings or many worlds: the commands ``ethbrake study sweep``, ``tune`` and ``falsify``."""
