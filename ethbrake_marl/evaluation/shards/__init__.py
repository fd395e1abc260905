"""Evaluations of lists that no memory holds: in shards, ranges of worlds whose statistics merge without rounding."""
