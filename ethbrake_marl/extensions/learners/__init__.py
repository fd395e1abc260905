"""Learning algorithms that try several actions in the same state: vine and rollout classification."""
