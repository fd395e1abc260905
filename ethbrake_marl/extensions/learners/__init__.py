"""Learning algorithms of this project: vine, mixtures of experts, rollout classification."""
