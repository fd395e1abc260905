"""Learning algorithms of this project: vine (also with a mixture of experts) and rollout classification."""
