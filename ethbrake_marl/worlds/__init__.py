"""Worlds: scenario files, and the worlds that are drawn from a scenario or given by the user."""
