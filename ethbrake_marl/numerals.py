"""How a number is written in every file and option: digits, a point, an exponent; no blanks inside, no underscores."""

from __future__ import annotations

import re

_NUMERAL = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def parse_numeral(text: str) -> float | None:
    """The number that ``text`` writes, infinite when it is too large; None when it writes none."""
    return float(text) if _NUMERAL.fullmatch(text) else None
