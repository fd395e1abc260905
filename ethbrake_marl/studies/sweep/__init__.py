"""Sweeps: many independent trainings from one file, and one table of what they reached."""
