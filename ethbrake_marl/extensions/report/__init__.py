"""HTML pages, figures and films."""
