"""Self-contained HTML pages: the frame, its parts, the episode player, and the report of an evaluation."""
