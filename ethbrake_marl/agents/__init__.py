"""Who drives: the loop that drives whole episodes, scripts, E-V2X-BM, and policies of any library."""
