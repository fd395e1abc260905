"""Proven bounds on harm: nobody can do less, whatever the controlled vehicle does."""
