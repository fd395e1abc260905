"""Whole command profiles: play them, and search for the one of least harm."""
