"""Proven bounds on harm that no behaviour of the controlled vehicles can beat."""
