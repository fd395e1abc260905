"""Extensions: optional parts of the package, one folder each.

The rest of the package works without the folder ``extensions``, because the table ``contents.py`` of an extension says
what it adds.
"""
