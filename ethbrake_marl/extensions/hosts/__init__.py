"""Driving worlds that another simulator moves; SUMO."""
