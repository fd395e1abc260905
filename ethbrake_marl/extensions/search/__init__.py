"""Search over whole command profiles: best known harm, its tables, the planner, ``+search``."""
