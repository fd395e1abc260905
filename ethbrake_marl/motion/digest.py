"""Which physics this is: a digest of the code in this folder."""

from __future__ import annotations

import hashlib
import tokenize
from functools import cache
from pathlib import Path

MEANING = (tokenize.NAME, tokenize.NUMBER, tokenize.OP)
FORM = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)


@cache
def physics_digest() -> str:
    """16 hexadecimal digits of the code of the physics, without comments and the content of texts.

    A docstring that is added or deleted changes them; other words in it do not.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        if path.name in ("compiling.py", Path(__file__).name):  # how it is compiled, and this file
            continue
        with tokenize.open(path) as lines:
            for token in tokenize.generate_tokens(lines.readline):
                if token.type in MEANING or token.type in FORM:
                    digest.update(f"{token.type if token.type in FORM else token.string} ".encode())
    return digest.hexdigest()[:16]
