"""Worlds: what a scenario file says, and the worlds that are drawn from it or given by the user."""
