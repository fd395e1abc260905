"""The learning algorithm vine, which tries two actions in the same state."""
