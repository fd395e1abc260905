"""Pictures, words and a window of running episodes."""
