"""The benchmark: a frozen suite of lists, an entry for each agent that drives it, and the table of all entries."""
