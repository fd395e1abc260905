"""The worlds in which an agent is worst: the search for them, and what is measured there."""
