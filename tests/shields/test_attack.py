"""Attacks on the shield: harm must equal the certified harm to the bit, and never exceed the bound at the alert.

About 100,000 times ``--size`` decisions through every interface and line, with both counts of harm and every way to
propose of ``attack.py``.
"""

import pytest

from tests.shields.attack import LINES, ONE, ONLY_ONE, PLAYS, WAYS, Total, attack

SHARES = {"parallel": 0.06, "vector": 0.28, "VecEnv": 0.28, "drive": 0.26, "search": 0.12}
DECISIONS = {"search": 9 * 45}  # of an episode, about
CELLS = [(play, name) for play in PLAYS for name in (ONE if play in ONLY_ONE else LINES)]


@pytest.mark.nightly
@pytest.mark.parametrize(("play", "name"), CELLS)
def test_harm_is_the_certified_harm(play: str, name: str, size: int) -> None:
    ways, lines = (
        [(count, way) for count in ("first", "total") for way in WAYS],
        len(ONE if play in ONLY_ONE else LINES),
    )
    worlds = max(1, round(100_000 * size * SHARES[play] / lines / len(ways) / DECISIONS.get(play, 45)))
    results = [attack(play, name, count, way, worlds, 1 + k) for k, (count, way) in enumerate(ways)]
    found = Total(*map(sum, zip(*results, strict=True)))
    print(found)
    assert found.held
