"""Search for the best commands: best known harm and its tables, the agents ``planner`` and ``+search``."""
