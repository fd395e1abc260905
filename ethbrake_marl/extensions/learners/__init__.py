"""Learning algorithms without exploration, critic or shaping: vine, mixtures of experts, and rollout classification."""
