"""Scenarios from recorded traffic: highD, exiD, NGSIM, OpenACC, and tables of trajectories."""
