"""Names of agents, shields and policies become things here: ``constant:3``, ``policy@runs/mine``, ``ppo+step``."""
