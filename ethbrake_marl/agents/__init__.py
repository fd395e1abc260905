"""Who drives: scripts, E-V2X-BM, trained policies, and the registry of names."""
