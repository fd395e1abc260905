"""Shields: check each proposed action, and replace it where the harm could rise above a bound."""
