"""Policies as plain files: read, checked and run without torch."""
