"""The exact, event-driven motion of ``n`` worlds, compiled with numba."""
