"""Proven lower bounds on harm: no commands of the controlled vehicles lead to less harm."""
