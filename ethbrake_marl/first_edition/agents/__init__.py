"""Agents that drive a vehicle (scripts, E-V2X-BM, trained policies) and the registry of their names."""
