"""The definition of the game: harm, objectives, actions, observations and rewards."""
