"""Mutants that compute the same as the code, each with the reason why no test can kill it."""

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "impact.py: 1.0 -> 2.0 in `1.0` (1)": "STRUCK is a mark: it is only compared with 0",
    "advance.py: 0 -> 1 in `0` (2)": "all of the arrays have as many rows as the first one",
}
