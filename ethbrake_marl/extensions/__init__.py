"""Extensions: optional parts of the package, one folder each.

The rest of the package works without the folder ``extensions``, because every extension registers itself by an entry
point.
"""
