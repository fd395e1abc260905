"""Shields: check each proposed action, and replace it where it could break a promise about harm."""
