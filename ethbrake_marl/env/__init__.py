"""The game: engine, actions, observations, rewards, and the interfaces around them."""
