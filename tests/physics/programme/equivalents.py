"""Mutants that compute the same as the code, each with the reason why no test can kill it.

The number in brackets tells apart the places of one file where the same change is possible.
"""

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "impact.py: 1.0 -> 2.0 in `1.0` (1)": "STRUCK is a mark: it is only compared with 0",
    "impact.py: `approaching = False` removed (2)": "resolving a cluster in which nobody approaches changes no bit",
    "impact.py: 12 -> 13 in `12` (1)": "one more row of the table, which nobody uses",
    "advance.py: 0 -> 1 in `0` (2)": "all of the arrays have as many rows as the first one",
    "events.py: Lt -> LtE in `acceleration < 0.0` (1)": "an acceleration of 0 has returned before",
    "packed.py: Sub -> Add in `params.shape[1] - 1` (1)": "floor division by 5 gives the same for 5 N + 1 - 1 and + 1",
    "harm.py: LtE -> Lt in `front_mass <= rear_mass` (1)": "equal masses: half of the harm by either branch",
}
