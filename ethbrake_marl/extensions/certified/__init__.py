"""Shields that do not know the true world: ``robust`` reckons with ranges, ``estimated`` with what was received."""
