"""Whose harm counts: fronts of what each vehicle bears, ``ethbrake study front``."""
