"""Studies of many training runs or many worlds, and the command ``ethbrake study falsify``."""
