"""Scenarios from recorded traffic: highD, NGSIM, OpenACC."""
