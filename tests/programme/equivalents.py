"""Mutants outside the physics that compute the same as the code, each with the reason why no test can kill it.

The number in brackets tells apart the places of one file where the same change is possible.
"""

from __future__ import annotations

NOT_LOST = "a uniform number of 1 or more is a link that is not lost, and the hop is not a part of the delay"

ONLY_TYPES = "only the type checker, which finds it, uses the name"

EQUIVALENT: dict[str, str] = {
    "scenario/v2x.py: 1.0 -> 2.0 in `1.0` (3)": NOT_LOST,
    "scenario/v2x.py: 1.0 -> 2.0 in `1.0` (4)": NOT_LOST,
    "studies/ablation.py: `Json = dict[str, Any]` removed (1)": ONLY_TYPES,
    "evaluation/statistics.py: 0 -> 1 in `0` (23)": "all sides have as many worlds, which was checked just before",
    "rewards.py: `Value = TypeVar('Value', float, Floats)` removed (1)": ONLY_TYPES,
}
