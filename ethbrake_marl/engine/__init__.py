"""The engine: it runs a batch of episodes, with a compiled step and a stream of worlds for new episodes."""
