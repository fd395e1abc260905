"""Extensions: optional parts of the package, one folder each.

The other modules work without this folder, because every extension registers itself by an entry point.
"""
