"""Shields for what is not known: uncertain worlds, estimated worlds, their bounds."""
