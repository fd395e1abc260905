"""The engine: reset and step for n worlds, their stream, their snapshots."""
