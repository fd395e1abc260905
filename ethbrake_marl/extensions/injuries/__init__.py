"""Changes of speed by impacts, and the injuries that are expected from them, as measures and as an objective."""
