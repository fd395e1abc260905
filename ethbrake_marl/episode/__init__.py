"""What happens in an episode: its state, one step, what is observed and rewarded, and what would happen."""
