"""Studies of many training runs or many worlds: the commands ``ethbrake study sweep``, ``tune`` and ``falsify``."""
