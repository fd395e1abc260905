"""Agents: the loop over whole episodes, scripts, E-V2X-BM, and policies of any library."""
