"""Messages between vehicles: what they contain, how old they are, and what a vehicle concludes from them."""
