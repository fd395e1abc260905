"""Exact, event-driven motion of ``n`` worlds (independent lines of vehicles), compiled with numba."""
