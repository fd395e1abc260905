"""Expected injuries of the impacts, as measures and as an objective."""
