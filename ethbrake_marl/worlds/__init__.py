"""Worlds: scenario files, and the worlds that are drawn from a scenario or supplied by the user."""
