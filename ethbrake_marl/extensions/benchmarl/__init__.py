"""BenchMARL tasks."""
