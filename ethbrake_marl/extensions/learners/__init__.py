"""Learning algorithms that try several actions in the same state: vine, mixtures of experts, rollout classification."""
