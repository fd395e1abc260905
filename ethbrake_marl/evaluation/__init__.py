"""What came of it: evaluate teams on fixed lists of worlds, measures, statistics, tables and files."""
