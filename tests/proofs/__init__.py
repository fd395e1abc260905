"""Statements about the package's own code that a solver proves: ``make proofs``."""
