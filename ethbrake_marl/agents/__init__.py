"""Who drives: the loop in which agents drive whole episodes, scripts, E-V2X-BM, and policies of any library."""
