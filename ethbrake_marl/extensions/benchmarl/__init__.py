"""Scenarios as BenchMARL tasks."""
