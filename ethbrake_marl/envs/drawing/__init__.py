"""Pictures of running episodes: what a moment shows (``scene``), as pixels, as text, in a window."""
