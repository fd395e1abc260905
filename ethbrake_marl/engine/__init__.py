"""The engine: a batch of running episodes, its compiled step, its stream of worlds."""
