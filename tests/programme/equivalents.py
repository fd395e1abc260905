"""Mutants outside the physics that compute the same as the code, each with the reason why no test can kill it.

The number in brackets tells apart the places of one file where the same change is possible.
"""

from __future__ import annotations

EQUIVALENT: dict[str, str] = {}
