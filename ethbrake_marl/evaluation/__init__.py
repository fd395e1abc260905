"""Evaluate teams on fixed lists of worlds: measures, statistics, tables and files."""
