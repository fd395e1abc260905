"""Proven lower bounds on harm: no command of the controlled vehicles does less harm."""
