"""Search for the best commands: best known harm and its tables, the agents ``best_harm`` and ``+search``."""
