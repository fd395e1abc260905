"""An episode: its state, one step, observations and rewards, and predictions of what would happen."""
