"""Fronts of harm: what each choice of whose harm counts costs whom; the command ``study front``."""
