"""Search for the best commands: best known harm, its tables, and the agent ``best_harm``."""
